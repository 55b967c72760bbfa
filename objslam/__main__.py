"""`python -m objslam` is `objslam`."""

from objslam.cli import main

if __name__ == "__main__":
    main()
