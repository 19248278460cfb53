"""`kgs poses`: the cameras of photos, without a fit."""

from pathlib import Path

from kgs._support.errors import DataError
from kgs.app.console import as_line, say_next
from kgs.app.files.results import Results

from .checks import check_frames
from .options import IfGiven, Out
from .tools import check_installed, load_tools


def poses(
    photos: Path,
    /,
    *,
    out: Out,
    frames: IfGiven[int] = None,
    masks: IfGiven[Path] = None,
    seed: int = 0,
) -> None:
    """Find the cameras of photos, and write a scene with poses that kgs fit and other programs take.

    For example:
      kgs poses PHOTOS -o SCENE
      kgs poses clip.mp4 -o SCENE --frames 20

    Args:
        photos: a folder of 3 or more photos, or a video.
        out: folder for the scene: images, sparse/0 (a COLMAP model) and photos.json (how the cameras were found).
        frames: how many frames are taken from a video. Unless given: twelve, fewer where the camera moves little, more
            where it moves far.
        masks: folder of masks, white where a photo is kept: IMG_1.png or IMG_1.jpg.png for IMG_1.jpg. Unless given:
            masks/ beside the photos.
        seed: of the solvers.
    """
    from kgs.app.sfm.source import Source

    source = Source.open(photos)
    if not source.is_unposed:
        raise DataError(photos, "", "photos without camera poses", "a scene", advice="kgs fit takes it as it is")
    check_frames(frames, source)
    check_installed("pycolmap")
    with Results.open(out, "photos", resume=False) as results:
        load_tools()

        from kgs.app.sfm.pose import pose

        pose(source, results, seed=seed, masks=masks, frames=frames)
    say_next(as_line("kgs", "fit", out, "-o", Path(f"{out.resolve().name}-fit")))
