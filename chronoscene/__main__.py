"""``python -m chronoscene`` is the command ``chronoscene``."""

from chronoscene.cli import main

if __name__ == "__main__":  # workers of a pool import this module, too
    main()
