"""The settings of the checks that name wrong input."""

from objslam.config.section import Section


class Checks(Section):
    """Configure the checks of the input in every run. `objslam doctor` runs them all."""

    use: bool = True
    """Look for wrong input, and give no object the status ok if it is found. false skips the search."""
