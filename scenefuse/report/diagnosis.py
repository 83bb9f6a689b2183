"""What probably went wrong with an object, in words: which photos, and what to photograph or click instead."""

import math
from collections.abc import Callable, Iterator

from scenefuse.report.run_summary import ObjectSummary
from scenefuse.report.values import Fields, find

# Names quoted of a list of photos.
MAX_NAMES = 5
# A wider angle without any photo leaves a side of the object unseen.
MAX_GAP_DEG = 100.0
# Masks are mentioned where more than this share of the photos is left out, or where the others agree by less (IoU).
MAX_LEFT_OUT, MIN_AGREEMENT = 0.1, 0.75
# Photos are mentioned that are more than this brighter or darker than the others, in stops (powers of two).
MAX_EXPOSURE_STOPS = 0.7


def diagnose(item: ObjectSummary) -> list[str]:
    """Sentences on an object's photos, masks and clicks, in the order of the stages; none where all is well."""
    return [sentence for cause in CAUSES for sentence in cause(item.stages)]


def named(items: list[str], mark: str = ", ") -> str:
    """Photos by their names, or sentences, with a mark between them; a few of many."""
    more = len(items) - MAX_NAMES
    return mark.join(items[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


def _split(fields: Fields) -> Iterator[str]:
    """Photos that were not placed, alone or as models of their own."""
    lost = set(find(fields, "sparse.not_registered") or [])
    for model in find(fields, "sparse.models_left_out") or []:
        apart = sorted(lost & set(model["photos"]))
        if apart:
            lost -= set(apart)
            yield (
                f"photos that form a model of their own, not linked to the rest ({len(apart)}): {named(apart)};"
                " photograph what lies between both groups, neighbours sharing two thirds of what they show"
            )
    if lost:
        yield (
            f"photos that could not be placed ({len(lost)}): {named(sorted(lost))}; blur, too little texture, or too"
            " little overlap with their neighbours: replace them, or photograph the steps between"
        )


def _misplaced(fields: Fields) -> Iterator[str]:
    """Photos whose matches the model does not explain."""
    doubtful = find(fields, "sparse.doubtful_photos") or {}
    if doubtful:
        yield (
            f"photos that may stand in wrong places ({len(doubtful)}): {named(sorted(doubtful))}; the model does not"
            " explain their matches with others. Look at their masks, photograph the steps between them and the others,"
            " or leave them out"
        )


def _one_side(fields: Fields) -> Iterator[str]:
    """A side from which there is no photo."""
    gap, between = find(fields, "undistorted.largest_gap_deg"), find(fields, "undistorted.gap_between")
    if gap is not None and gap > MAX_GAP_DEG:
        yield (
            f"{gap:.0f} degrees without a photo, between {between[0]} and {between[1]}: what can only"
            " be seen from there is missing; photograph it from there, if one can stand there"
        )


def _clicks(fields: Fields) -> Iterator[str]:
    """Clicks that disagree with the others."""
    left_out = find(fields, "masks.clicks_left_out") or []
    if left_out:
        yield (
            f"clicks that disagree with the others and are left out ({len(left_out)}): {named(left_out, '; ')}; correct"
            " them in the page that scenefuse pick opens, or delete them"
        )


def _masks(fields: Fields) -> Iterator[str]:
    """Masks that disagree with each other."""
    left_out, photos = find(fields, "masks.photos_left_out") or [], find(fields, "masks.photos") or 0
    if len(left_out) > MAX_LEFT_OUT * photos:
        yield (
            f"{len(left_out)} of {photos} masks disagree with the others and are left out ({named(left_out)}): look at"
            " masks.png; click the object's ends, or what the masks take by mistake, in one of these photos"
        )
    agreement = find(fields, "masks.median_agreement")
    if agreement is not None and agreement < MIN_AGREEMENT:
        yield (
            f"the masks that are left agree by {agreement:.2f} only (IoU with their common hull): they hold different"
            " things in different photos, or the cameras are wrong; look at masks.png"
        )


def _exposed(fields: Fields) -> Iterator[str]:
    """Photos that are blurred, or much brighter or darker than the others, in the order of that."""
    blurred = find(fields, "stage2.blurred_photos")
    if blurred:
        names = sorted(blurred)
        yield f"blurred photos ({len(names)}): {named(names)}; they count less in the NeRF: replace or remove them"
    gains = find(fields, "stage2.photo_gains") or {}
    stops = {name: abs(math.log2(sum(gain) / len(gain))) for name, gain in gains.items()}
    jumps = sorted((name for name in stops if stops[name] > MAX_EXPOSURE_STOPS), key=lambda name: -stops[name])
    if jumps:
        yield (
            f"photos more than {MAX_EXPOSURE_STOPS:g} stops brighter or darker than the others ({len(jumps)}):"
            f" {named(jumps)}; training evens this out, but what is too dark or too bright holds no detail: fix the"
            " exposure while photographing"
        )


def _unlinked(fields: Fields) -> Iterator[str]:
    """Nothing that the photos of object and scene share."""
    if find(fields, "alignment.found") is False:
        yield (
            f"its photos are not linked with the scene's ({find(fields, 'alignment.reason')}): add a few photos from"
            " distances between those of the flight and of the close-ups, with the surroundings in view"
        )


CAUSES: tuple[Callable[[Fields], Iterator[str]], ...] = (
    _split,
    _misplaced,
    _one_side,
    _clicks,
    _masks,
    _exposed,
    _unlinked,
)
