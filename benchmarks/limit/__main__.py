"""`python benchmarks/limit`: see measure.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.append(str(Path(__file__).parent.parent))  # what the benchmarks share
    from measure import main

    main()
