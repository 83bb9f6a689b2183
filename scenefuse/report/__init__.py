"""Pictures, tables, summary and report page of a run."""
