"""Write the report on paper."""

from scenefuse.core.stage import run
from scenefuse.report.write_pdf import write_pdf

if __name__ == "__main__":
    run(write_pdf)
