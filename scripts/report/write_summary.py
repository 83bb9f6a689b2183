"""Write the tables and the text summary of a run."""

from scenefuse.report.write_summary import write_summary
from scenefuse.stage import run

if __name__ == "__main__":
    run(write_summary)
