"""Write the report page of a run."""

from scenefuse.stage import run
from scenefuse.viz.report import write_report

if __name__ == "__main__":
    run(write_report)
