"""No benchmark may rot unseen: each can be imported as long as the library has what it uses."""

import importlib
import sys

import pytest

from structure import ROOT

#: These run in the peers' own environment.
FOR_PEERS = {"peers"}
FOLDER = ROOT / "benchmarks"
MODULES = sorted(
    ".".join(path.relative_to(FOLDER).with_suffix("").parts)
    for path in FOLDER.rglob("*.py")
    if path.stem not in FOR_PEERS | {"__init__"}
)


@pytest.mark.parametrize("name", MODULES)
def test_every_benchmark_finds_what_it_uses(name, monkeypatch):
    # Those that use the tests' tools add them to the path, which shall not stay.
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert importlib.import_module(name).__doc__
