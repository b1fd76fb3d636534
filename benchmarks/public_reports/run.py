"""All public reports that were rebuilt: logs, and descriptions with tools and loads.

python benchmarks/public_reports/run.py [--quick] [--json FILE]
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import timing


def main():
    """Rebuild all reports."""
    options = timing.parser(__doc__, "every sixth report").parse_args()
    timing.pin_to(1)
    import logs
    import robots

    rows = [*logs.rows(options.quick), *robots.rows(options.quick)]
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
