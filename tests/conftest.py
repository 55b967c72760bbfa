"""What holds for all tests."""

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "objslam",
    deadline=None,  # No example is too slow. That depends on what else the machine does.
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="OBJSLAM_FUZZ_SEED" not in os.environ,  # The same examples in every run. tools/fuzz.sh looks for new ones.
)
settings.load_profile("objslam")
