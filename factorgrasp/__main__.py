"""``python -m factorgrasp``: the command line."""

from __future__ import annotations

from factorgrasp.cli import main

if __name__ == "__main__":
    main()
