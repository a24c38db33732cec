"""The verb `windows`: training data of reference trajectories in one file."""

from __future__ import annotations

from pathlib import Path

from surrogate.verbs.options import PathLike, Trajectories, WindowsOptions
from surrogate.verbs.outputs import check_outputs, find_trajectories
from systems.errors import InputError
from systems.options import options_as_keywords


@options_as_keywords(WindowsOptions)
def windows(references: Trajectories, out: PathLike, options: WindowsOptions) -> Path:
    """Read reference trajectories of one scene, canonicalise them once, and write one compact file for training.

    They may be larger than memory. `validation`: trajectories held out whole; without any, the last twentieth of each
    is. `velocities` keeps these as well, for PAINET, and leaves frames in their own pose. Raises InputError when
    scenes, save intervals or conditions differ, TrajectoryError for damaged files.
    """
    from surrogate.data import load_frames, write_windows

    out = Path(out)
    check_outputs([out], [".h5"], overwrite=options.overwrite)
    paths = find_trajectories(references, verify=True)
    held = [] if options.validation is None else find_trajectories(options.validation, verify=True)
    canonical = options.canonical and not options.velocities
    write_windows(paths, out, canonical=canonical, velocities=options.velocities, held=held)
    try:
        load_frames(out).refuse_leaks()
    except InputError:
        out.unlink()
        raise
    return out
