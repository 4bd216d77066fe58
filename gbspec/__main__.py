"""`python -m gbspec`: the same as the `gbspec` command."""

from gbspec.cli import main

if __name__ == "__main__":
    main()
