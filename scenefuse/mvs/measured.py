"""Where a match is a measurement: the photos match there, worse beside it, and not only because an edge is near.

A high correlation alone says little: a shaded wall matches at all depths, and a blank sky does where an edge reaches
into its windows.
"""

import torch
from torch import Tensor

from scenefuse.geometry.matcher import Matcher, support_weights, supported_mean

PEAK_PX = 1.5
"""How far beside a match, in pixels of the middle one of the source photos, it must be worse."""
PEAK, PEAK_PER_NOISE = 0.02, 0.25
"""By how much, in NCC, and how much more for noise as strong as the texture: in that ratio noise changes NCC."""
LOOK_PX = 11
"""Side of the windows in which the pixels around are looked at, twice over."""
MOST_BLANK = 0.25
"""Largest share of blank pixels among those that look alike: the glow beside an edge lies at the rim of a blank sky."""


def is_measured(matcher: Matcher, inverse: Tensor, score: Tensor, min_score: float, pixel: float) -> Tensor:
    """Where an inverse depth (h, w) is a measurement, (h, w) bool.

    Args:
        matcher: that found it.
        inverse: (h, w) inverse depths.
        score: (h, w) their mean NCC.
        min_score: smallest score of a match, -1..1.
        pixel: difference of inverse depth that moves a pixel by one in the middle one of the source photos.
    """
    beside = matcher.score(torch.stack([inverse - PEAK_PX * pixel, inverse + PEAK_PX * pixel])).amax(0)
    noise = matcher.flat / matcher.variance.clamp(min=1e-12)
    measured = (score >= min_score) & (score - beside >= PEAK + PEAK_PER_NOISE * noise)
    return measured & ~_among_blank(matcher, measured)


def _among_blank(matcher: Matcher, measured: Tensor) -> Tensor:
    """True (h, w) where of the pixels around that look alike too many have neither texture nor a measurement."""
    weights = support_weights(matcher.reference, LOOK_PX)
    known, blank = measured.float(), (~measured & (matcher.variance < matcher.flat)).float()
    for _ in range(2):
        known, blank = (supported_mean(values, weights) for values in (known, blank))
    return blank > MOST_BLANK * (known + blank)
