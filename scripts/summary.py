"""Write the tables and the text summary of a run."""

from scenefuse.stage import run
from scenefuse.viz.summary import write_summary

if __name__ == "__main__":
    run(write_summary)
