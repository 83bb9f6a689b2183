"""Write the tables and the text summary of a run."""

from scenefuse.core.stage import run
from scenefuse.report.write_summary import write_summary

if __name__ == "__main__":
    run(write_summary)
