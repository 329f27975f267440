"""`python -m stereoreg_ros.cli`."""

from stereoreg_ros.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
