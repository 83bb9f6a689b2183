# The workflow, for those who start Snakemake in this folder; it is in workflow/, where Snakemake's catalogue looks for it.
include: "workflow/Snakefile"


# An included file does not say what is made by default.
workflow.default_target = workflow.default_target or workflow.modifier.modify_rulename(
    "all"
)
