"""Settings shared by all tests."""

from hypothesis import settings

# No deadline: the first call of a kernel includes its import. Derandomised: a red run can be repeated.
settings.register_profile("planish", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("planish")
