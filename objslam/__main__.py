"""Entry point of `python -m objslam`, which runs the command `objslam`."""

from objslam.cli import main

if __name__ == "__main__":
    main()
