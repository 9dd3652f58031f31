"""From images of a board to a calibrated rig: calibrate(), one line per stage."""

from __future__ import annotations

from pathlib import Path

from planish.options import thread_count
from planish.pipeline.registering import Progress
from planish.sensing.calibrate.boards.observe import observe_boards
from planish.sensing.calibrate.calibrate import CalibrateOptions
from planish.sensing.calibrate.calibrate import calibrate as adjust_rig
from planish.sensing.calibrate.result import Calibration


def calibrate(
    boards: Path,
    options: CalibrateOptions | None = None,
    *,
    board: Path | None = None,
    images_dir: Path | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Return the rig that the images of a board calibrate, with its covariance and what it rests on.

    Parameters
    ----------
    boards : Path
        What was recorded: `boards.json`, or a folder.
    options : CalibrateOptions
        Default: all defaults.
    board : Path or None
        The board file, where the recording does not name it.
    images_dir : Path or None
        Folder the image names are relative to.
    threads : int or None
        Number of threads; the result does not depend on it.
    progress : callable, optional
        Called with stage, done, to do.

    Raises
    ------
    InputError
        Where the images do not suffice for a calibration; the message names what is missing.
    """
    count = thread_count(threads)
    observations = observe_boards(boards, board, images_dir, count, progress)
    return adjust_rig(observations, options or CalibrateOptions(), progress, count)
