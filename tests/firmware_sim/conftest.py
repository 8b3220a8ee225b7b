"""What the tests of the emulated devices share."""

import pytest
from bench_host import BenchHost


@pytest.fixture
def host() -> BenchHost:
    return BenchHost()
