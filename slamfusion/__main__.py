"""``python -m slamfusion``: the command line."""

from slamfusion.cli.main import main

if __name__ == "__main__":
    main()
