"""Write the report page of a run."""

from scenefuse.core.stage import run
from scenefuse.report.write_report import write_report

if __name__ == "__main__":
    run(write_report)
