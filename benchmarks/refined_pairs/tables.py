"""Tables of the refinement's benchmark, from the cells that are there."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.stats import chi2

from coarse_pairs.parts import SURFACES
from render_tables import save_table
from shared.cells import Rows, machines, read_rows

FOLDER = "refine"
#: Textures by their grain: name and least.
GRAINS = ((">= 1 %", 0.01), ("0.5 to 1 %", 0.005), ("below 0.5 %", 0.0))
#: 95 of 100 squared errors with a right covariance of six directions, and of one, are below these.
LIMIT_6, LIMIT_1 = float(chi2.ppf(0.95, 6)), float(chi2.ppf(0.95, 1))
COMMAND = "python benchmarks/refine.py"

Row = dict[str, Any]


def save_tables() -> None:
    """Save all tables whose cells are there, and print them."""
    rows = read_rows(FOLDER)
    for study, make in (
        ("accuracy", _accuracy),
        ("scenes", _efficiency),
        ("scenes", _convergence),
        ("covariance", _covariance),
        ("failures", _failures),
        ("beside", _beside),
    ):
        of_it = [r for r in rows if r["study"] == study]
        if of_it:
            make(of_it)


def _save(name: str, columns: dict[str, str], table: Rows, study: str, formats: dict[str, str]) -> None:
    machine = machines(FOLDER, f"{study.split()[0]}_*")
    save_table(f"refine-{name}", columns, table, f"{COMMAND} {study}", formats, machine=machine)
    print(*table, sep="\n")


def _percentiles(rows: Rows, key: str) -> tuple[float | None, float | None]:
    values = [r[key] for r in rows if r.get(key) is not None]
    return (float(np.median(values)), float(np.percentile(values, 95))) if values else (None, None)


def _ratio_of_squares(rows: Rows, over: str, under: str) -> float:
    return float(sum(r[over] ** 2 for r in rows) / sum(r[under] ** 2 for r in rows))


def _accuracy(rows: Rows) -> None:
    table = []
    most = 1.0
    for name, least in GRAINS:
        for surface in ("all", *SURFACES):
            of_it = [r for r in rows if least <= r["grain"] < most and surface in ("all", r["surface"])]
            if not of_it:
                continue
            done = [r for r in of_it if r["along_mm"] is not None]
            row: Row = {"grain": name, "surface": surface, "pairs": len(of_it), "accepted": len(done)}
            row["coarse"], _ = _percentiles(done, "coarse_along_mm")
            row["along"], row["along_95"] = _percentiles(done, "along_mm")
            row["normal"], row["normal_95"] = _percentiles(done, "normal_mm")
            table.append(row)
        most = least
    columns = {
        "grain": "grain", "surface": "surface", "pairs": "pairs", "accepted": "accepted",
        "coarse": "before refinement, along, median [mm]", "along": "along, median [mm]", "along_95": "95 % [mm]",
        "normal": "normal, median [mm]", "normal_95": "95 % [mm]",
    }  # fmt: skip
    formats = dict.fromkeys(("coarse", "along", "along_95", "normal", "normal_95"), ".4f")
    _save("accuracy", columns, table, "accuracy", formats)


def _efficiency(rows: Rows) -> None:
    table = []
    for kind in _kinds(rows):
        of_it = [r for r in rows if r["kind"] == kind and "bound_along_mm" in r]
        if not of_it:
            continue
        along, along_95 = _percentiles(of_it, "along_mm")
        table.append({
            "kind": kind, "pairs": len(of_it), "along": along, "along_95": along_95,
            "stated": _percentiles(of_it, "stated_along_mm")[0],
            "bound": _percentiles(of_it, "bound_along_mm")[0], "normal": _percentiles(of_it, "normal_mm")[0],
            "bound_normal": _percentiles(of_it, "bound_normal_mm")[0],
            "efficiency": _ratio_of_squares(of_it, "bound_along_mm", "along_mm"),
            "efficiency_normal": _ratio_of_squares(of_it, "bound_normal_mm", "normal_mm"),
            "typical": 6 / float(np.median([r["squares_over_bound"] for r in of_it])) * float(chi2.median(6)) / 6,
        })  # fmt: skip
    columns = {
        "kind": "scene, grain [%]", "pairs": "pairs", "along": "along, median [mm]", "along_95": "95 % [mm]",
        "stated": "stated sigma, median [mm]", "bound": "least possible, median [mm]", "normal": "normal, median [mm]",
        "bound_normal": "least possible, median [mm]", "efficiency": "efficiency along", "efficiency_normal": "normal",
        "typical": "of the typical pair, all six directions",
    }  # fmt: skip
    formats = dict.fromkeys(("along", "along_95", "stated", "bound", "normal", "bound_normal"), ".4f")
    formats |= dict.fromkeys(("efficiency", "efficiency_normal", "typical"), ".2f")
    _save("efficiency", columns, table, "scenes", formats)


def _convergence(rows: Rows) -> None:
    table = []
    for kind in _kinds(rows):
        of_it = [r for r in rows if r["kind"] == kind and r.get("starts")]
        if of_it:
            starts, failed = sum(r["starts"] for r in of_it), sum(len(r["failed"]) for r in of_it)
            table.append({"kind": kind, "shift": of_it[0]["shift_mm"], "turn": of_it[0]["turn_deg"],
                          "pairs": len(of_it), "starts": starts, "converged": 100 * (1 - failed / starts)})  # fmt: skip
    columns = {"kind": "scene, grain [%]", "shift": "shift [mm]", "turn": "turn [deg]", "pairs": "pairs",
               "starts": "starts", "converged": "converged [%]"}  # fmt: skip
    _save("convergence", columns, table, "scenes", {"converged": ".1f"})


def _covariance(rows: Rows) -> None:
    table = []
    groups = sorted({(r["kind"], r["rig"] == "drawn", r["noise"], r["scale"]) for r in rows})
    for kind, drawn, noise, scale in groups:
        rig, z_key = ("drawn", "z_total") if drawn else ("exact", "z_noise")
        of_it = [r for r in rows if (r["kind"], r["rig"], r["noise"], r["scale"]) == (kind, rig, noise, scale)]
        z = np.array([r[z_key] for r in of_it if z_key in r])
        if not len(z):
            continue
        squares = (z**2).sum(1)
        table.append({
            "kind": kind, "rig": rig, "noise": noise, "scale": scale, "pairs": len(z),
            "nees": float(squares.mean() / 6), "median": float(np.median(squares) / chi2.median(6)),
            "coverage": 100 * float((squares < LIMIT_6).mean()),
            **{f"axis{i}": float(v) for i, v in enumerate((z**2).mean(0))},
            "axes_covered": 100 * float((z**2 < LIMIT_1).mean()),
        })  # fmt: skip
    columns = {
        "kind": "scene, grain [%]", "rig": "rig", "noise": "noise x", "scale": "resolution", "pairs": "pairs",
        "nees": "mean NEES / 6", "median": "median NEES over its own", "coverage": "within 95 % [%]",
        **{f"axis{i}": "mean square, widest axis" if i == 0 else f"{i + 1}." for i in range(6)},
        "axes_covered": "axes within 95 % [%]",
    }  # fmt: skip
    formats = dict.fromkeys(("nees", "median", *(f"axis{i}" for i in range(6))), ".2f")
    _save("covariance", columns, table, "covariance", formats | {"coverage": ".1f", "axes_covered": ".1f"})


def _failures(rows: Rows) -> None:
    table = []
    witnesses = ("by_kept_out", "by_residuals", "by_drift")
    for kind in sorted({r["kind"] for r in rows}):
        ends = [r for r in rows if r["kind"] == kind and r["off_mm"] is not None]
        wrong, right = ([r for r in ends if r["beside"] == beside] for beside in (True, False))
        table.append(
            {
                "kind": kind,
                "right": len(right),
                "refused": sum(any(r[w] for w in witnesses) for r in right),
                "least": min((r["common_texture"] for r in right), default=None),
                "wrong": len(wrong),
                **{w: sum(r[w] for r in wrong) for w in witnesses},
                "none": sum(not any(r[w] for w in witnesses) for r in wrong),
            }
        )
    columns = {
        "kind": "scene, grain [%]", "right": "right ends", "refused": "of them refused",
        "least": "their textures in common, least", "wrong": "wrong optima", "by_kept_out": "refused by tiles kept out",
        "by_residuals": "by residuals", "by_drift": "by drift from the windows", "none": "by none",
    }  # fmt: skip
    _save("failures", columns, table, "failures --scale 0.5", {"least": ".2f"})


def _beside(rows: Rows) -> None:
    table = []
    for kind in _kinds(rows):
        of_it = [r for r in rows if r["kind"] == kind]
        for method, what, chosen in _methods(of_it):
            row: Row = {"kind": kind, "method": method, "what": what, "pairs": len({r["number"] for r in chosen})}
            for key in ("along", "normal"):
                row[key], _ = _percentiles(chosen, f"{key}_mm")
            for key in ("seconds", "prepared_s"):
                row[key], _ = _percentiles(chosen, key)
            table.append(row)
    columns = {"kind": "scene, grain [%]", "method": "method", "what": "settings", "pairs": "pairs",
               "along": "along, median [mm]", "normal": "normal, median [mm]", "seconds": "refinement [s]",
               "prepared_s": "its preparation [s]"}  # fmt: skip
    _save("beside", columns, table, "beside", {"along": ".4f", "normal": ".4f", "seconds": ".2f", "prepared_s": ".2f"})


def _methods(rows: Rows) -> Iterable[tuple[str, str, Rows]]:
    """Yield method, settings in words and rows: with the recommended settings, and the best of each pair by truth."""
    for method in ("start", "planish"):
        yield method, "", [r for r in rows if r["method"] == method]
    for method in dict.fromkeys(r["method"] for r in rows if r["method"] not in ("start", "planish")):
        of_it = [r for r in rows if r["method"] == method]
        recommended = [r for r in of_it if r["recommended"]]
        yield method, "recommended: " + _words(recommended[0]["settings"]), recommended
        by_pair = [[r for r in of_it if r["number"] == n] for n in sorted({r["number"] for r in of_it})]
        best = [min(tried, key=lambda r: r["along_mm"]) for tried in by_pair]
        yield method, f"best of {len(by_pair[0])} for each pair; first: {_words(best[0]['settings'])}", best


def _words(settings: Row) -> str:
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def _kinds(rows: Rows) -> list[str]:
    return list(dict.fromkeys(r["kind"] for r in sorted(rows, key=lambda r: r["kind"])))
