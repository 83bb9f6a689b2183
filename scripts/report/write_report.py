"""Write the report page of a run."""

from scenefuse.report.write_report import write_report
from scenefuse.stage import run

if __name__ == "__main__":
    run(write_report)
