"""Register all captures of a folder: python examples/register_captures.py demo-out/captures."""

import sys
from pathlib import Path

from planish import Capture, measure, register


def main(folder: Path) -> None:
    """Measure and register every capture in `folder` and print where each measurement stands."""
    captures = [Capture.load(path.parent) for path in sorted(folder.glob("*/capture.json"))]
    registration = register([measure(capture) for capture in captures])
    for pair in registration.pairs:
        print(f"{pair.a}, {pair.b}: {pair.status}: {pair.reason}")
    for item in registration.measurements:
        x, y, z = item.T_world_measurement[:3, 3]
        print(f"{item.name}: group {item.group}, origin at ({x:.3f}, {y:.3f}, {z:.3f}) mm in the world")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
