"""The targets write bags as the tests of the bag readers do, and push to the sink that the tests of live sessions use."""

import sys
from pathlib import Path

sys.path += [str(Path(__file__).parents[1] / part) for part in ("sources/ros", "live")]
