"""The settings of the checks that find wrong input."""

from objslam.config.section import Section


class Checks(Section):
    """Configure the checks of the input in every run. `objslam doctor` runs them all."""

    use: bool = True
    """Check the input, and give no object the status ok if the input is wrong. false: do not check the input."""
