"""Tables of the statistics of the coarse registration, from the cells that are there."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from typing import Any

from coarse_pairs.parts import OVERLAPS, SURFACES
from render_tables import save_table
from shared.cells import Rows, machines, read_rows

FOLDER = "coarse"
#: A transform is right if it moves the overlap by less than this, root mean square [mm].
RIGHT_MM = 1.0
#: Key and heading of the peers; plain SIFT saw all pairs, the others some.
PEERS = {"sift_mm": "plain SIFT", "fpfh_ransac_mm": "FPFH + RANSAC", "fgr_mm": "FGR", "kiss_matcher_mm": "KISS-Matcher"}

#: What is printed of a pair that failed.
TOLD = (
    "number", "first", "second", "surface", "overlap", "density", "grain", "specular", "tilt_deg", "coarse_mm",
    "refined_mm", "status", "reason",
)  # fmt: skip

Row = dict[str, Any]


def enough_texture(row: Row) -> bool:
    """Return whether the surface has marks or grain to count on."""
    return bool(row["density"] >= 0.3 or row["grain"] >= 0.005)


def is_right(row: Row) -> bool:
    """Return whether planish accepted the pair with the right transform before refinement."""
    return row["status"] == "accepted" and row["coarse_mm"] is not None and row["coarse_mm"] <= RIGHT_MM


def is_wrong(row: Row) -> bool:
    """Return whether planish accepted the pair with a wrong transform."""
    return row["status"] == "accepted" and (row["refined_mm"] is None or row["refined_mm"] > RIGHT_MM)


STRATA: dict[str, Callable[[Row], bool]] = {
    "overlap >= 30 %, density >= 0.3 or grain >= 0.5 %": lambda r: r["overlap"] >= 0.3 and enough_texture(r),
    "overlap >= 30 %, less texture": lambda r: r["overlap"] >= 0.3 and not enough_texture(r),
    "overlap 15-30 %": lambda r: r["overlap"] < 0.3,
    **{
        f"{name}, overlap >= 30 %": lambda r, name=name: r["surface"] == name and r["overlap"] >= 0.3  # type: ignore[misc]
        for name in SURFACES
    },
}


def cases() -> Rows:
    """Return the records within the range of overlaps; what could not be measured is none of the registration's."""
    return [r for r in read_rows(FOLDER) if "overlap" in r and OVERLAPS[0] <= r["overlap"] <= OVERLAPS[1]]


def save_tables() -> None:
    """Save the tables `coarse`, `coarse-lost` and print what went wrong."""
    rows = cases()
    if not rows:
        return
    table = []
    for scale, name in ((0.5, "half"), (1.0, "full")):
        for stratum, belongs in STRATA.items():
            of_it = [r for r in rows if r["scale"] == scale and belongs(r)]
            if of_it:
                table.append({"resolution": name, "stratum": stratum} | _summary(of_it))
    columns = {
        "resolution": "resolution", "stratum": "pairs", "pairs": "number", "right": "right [%]",
        "wrong": "wrong, accepted", "median": "error before refinement, median [mm]",
    } | {key: f"{heading}, right [%]" for key, heading in PEERS.items()}  # fmt: skip
    formats = {"right": ".1f", "median": ".3f"}
    save_table("coarse", columns, table, "python benchmarks/coarse.py", formats, machine=machines(FOLDER))
    for row in table:
        print(row)
    _save_lost(rows)


def _summary(rows: Rows) -> Row:
    errors = [r["coarse_mm"] for r in rows if is_right(r)]
    summary: Row = {
        "pairs": len(rows),
        "right": 100 * sum(map(is_right, rows)) / len(rows),
        "wrong": sum(map(is_wrong, rows)),
        "median": median(errors) if errors else None,
    }
    for key in PEERS:
        asked = [r for r in rows if key in r]
        if asked:
            found = sum(r[key] is not None and r[key] <= RIGHT_MM for r in asked)
            few = "" if len(asked) == len(rows) else f" (of {len(asked)})"
            summary[key] = f"{100 * found / len(asked):.1f}{few}"
    return summary


def _save_lost(rows: Rows) -> None:
    """Save the pairs that plain SIFT wins and planish loses, with the reasons."""
    lost = [r for r in rows if r.get("sift_mm") is not None and r["sift_mm"] <= RIGHT_MM and not is_right(r)]
    columns = {
        "number": "part", "pair": "captures", "surface": "surface", "overlap": "overlap", "density": "density",
        "grain": "grain", "sift_mm": "plain SIFT [mm]", "coarse_mm": "planish, before refinement [mm]",
        "status": "status", "reason": "reason",
    }  # fmt: skip
    named = [r | {"pair": f"{r['first']}, {r['second']}"} for r in lost]
    table = [{key: r.get(key) for key in columns} for r in named]
    formats = {"overlap": ".2f"}
    save_table("coarse-lost", columns, table, "python benchmarks/coarse.py", formats, machine=machines(FOLDER))
    wrong = [r for r in rows if is_wrong(r)]
    print(f"plain SIFT wins and planish loses: {len(lost)} of {len(rows)}; accepted, but wrong: {len(wrong)}")
    for r in [r for r in rows if not is_right(r) and r["overlap"] >= 0.3 and enough_texture(r)] + wrong:
        print({key: r.get(key) for key in TOLD})
