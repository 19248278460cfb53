"""`kgs poses`: the cameras of photos, without a fit."""

from pathlib import Path

from kgs._support.errors import DataError
from kgs.app.console import as_line, each, say, say_next

from .checks import check_photos
from .options import IfGiven, Out
from .tools import check_installed, load_tools
from .unposed import check_frames, notes_on_photos, open_scene


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
    from kgs.app.files.publishing import UNFINISHED
    from kgs.app.files.results_folder import has_fit

    if open_scene(photos) is not None:
        raise DataError(photos, "", "photos without camera poses", "a scene", advice="kgs fit takes it as it is")
    check_frames(frames, photos)
    check_installed("pycolmap")
    check_photos(photos, out, frames=frames)
    if has_fit(out) or has_fit(out / UNFINISHED):
        raise DataError(
            out, "", "a folder without a fit", "one, to which its cameras belong", advice="choose another folder"
        )
    load_tools()

    from kgs.app.sfm import pose_photos

    for note in notes_on_photos(photos, masks):
        say(note)
    pose_photos(photos, out, seed=seed, masks=masks, frames=frames, bar=each, say=say)
    say_next(as_line("kgs", "fit", out, "-o", Path(f"{out.resolve().name}-fit")))
