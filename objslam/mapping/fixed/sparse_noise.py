"""Estimate the noise of a log that sees each thing from few places, such as a street past which a car with GPS drives.

With the usual noise, the rays of such a log do not meet, and no objects are found whose residuals could show the noise. So
objects are searched with many assumed noises, and the noise with the most evidence is taken. The evidence is the odds of the
objects over stray boxes, and how likely their detections and misses are. The result is rough. So the noise is then estimated
from the residuals of the objects (`residual_noise`), from several starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.errors import LogError
from objslam.frontend.known_errors import coarse
from objslam.mapping.checks.diagnosis import Diagnosis, diagnose
from objslam.mapping.checks.finding import NOISIER, Finding
from objslam.mapping.checks.hypotheses.disagreement import DISAGREE
from objslam.mapping.checks.hypotheses.every import coarse_hypotheses, with_headings
from objslam.mapping.fixed.few_box_search import Searched, SparseNoise, middle, search_objects
from objslam.mapping.fixed.residual_noise import gain_of_shared_places, noise_of_residuals
from objslam.mapping.progress import Progress

_PLACES = (1.0, 2.0, 6.0, 20.0, 60.0, 200.0)
"""The factors on `localization.xy` that are tried first. With more factors, the noise of more logs is found, and the search
takes longer."""
_RANGES = (1.0, 3.0, 8.0)
"""The factors on the noise of depths that are tried first. With more factors, the search takes longer."""
_RAYS = (1.0, 4.0)
"""The factors on the noise of rays that are tried first. On a street, noisy rays look almost like noisy places."""
_TURN = 15
"""The step (degrees) between the tried turns of all cameras about the vertical axis. With a larger step, more wrong mounts
are missed."""
_LEAD = 15.0
"""The least lead, in log odds, of the log as it is over the log with turned cameras. On streets, the lead is 18 and more. If
a mount is wrong by 15 degrees and more, the lead is below 0 on streets, and mostly in rooms too. With a larger lead, fewer
streets are mapped. With a smaller lead, wrong mounts are taken for noise."""
_SURE = 60.0
"""The lead, in log odds, from which a finding that the boxes disagree is dropped. The boxes may only seem to disagree,
because each thing has few boxes. With a larger lead, more right streets with few boxes count as wrong."""
_BETTER = 40.0
"""The least lead, in log odds, of the log with a usual mistake corrected over the log as it is, so that the input counts as
wrong. A straight street looks like its mirror image. So the correction of a mistake that is not there leads by up to 25, by
chance. With a larger value, mistakes are more often taken for noise."""
_MOST_VIEWS = 12.0
"""The largest mean number of boxes of an object in a log that sees each thing from few places. Streets have 4. If objects
with more boxes still disagree, wrong input is likelier than noise, because the frames would show the noise. With a larger
number, a turned camera is more often taken for noisy places."""
_FEWEST = 20
"""The fewest boxes of a log that is searched. Fewer boxes agree with any noise by chance."""
_NEAR = 30.0
"""The largest distance, in log odds, from the likeliest noise to a noise that is tried as a start. With a larger number,
more starts are tried, and each takes about a second."""
_NOISY = 3.0
"""The least factor on `localization.xy` at which places count as noisy. If any start leads to noisy places, results with
more exact places are left out. Those results explain the misses by large errors of the boxes. Such errors are rare, and the
sigmas would be too small. With a larger factor, noisy places are more often taken for a bad detector."""
_SETTLED = 2
"""The number of searches with noise that was estimated from the residuals of all rays of a moment. A third search gave the
same objects on 15 simulated streets. With a larger number, the run takes longer."""
_OTHERS = 2
"""The number of likeliest noises that are tried if the input seems wrong with the first noise. With a larger number, wrong
input is more often taken for noise."""
_CLEAR = 20.0
"""The least growth of the log odds of objects over stray boxes, from the noise in the settings to another noise. Dozens of
noises are tried, so some growth is chance. With a larger value, a street needs more boxes."""


def with_sparse_noise(
    log: Log, settings: Settings, diagnosis: Diagnosis, ledger: Ledger, progress: Progress
) -> tuple[Settings, Diagnosis]:
    """Return settings with the noise of a log whose boxes disagree only because the settings say too little noise.

    diagnosis: the findings about the log with the noise in the settings. If the boxes agree with another noise, the returned
    diagnosis is of the log with this noise, and says so. If the boxes agree with the noise in the settings, the finding that
    they disagree is dropped. If the settings have much noise, the diagnosis may get the finding that the cameras are turned.
    Otherwise the settings and the diagnosis are returned unchanged.
    """
    boxes = sum(len(one.detections) for one in log.cameras if one.detections is not None)
    if diagnosis.certain or log.localization is None or boxes < _FEWEST:
        return settings, diagnosis
    accused = any(one.name == DISAGREE for one in diagnosis.findings)
    if diagnosis.spoilt if coarse(settings) else not accused:
        return settings, diagnosis
    try:
        if coarse(settings):
            found = _turned_cameras(log, settings, progress)
            return settings, diagnosis.with_findings([found] if found else [])
        noises, lead = sparse_noise(log, settings, progress)
    except LogError:  # No frame of the part lies on the path. If no frame of the log does, the run says so.
        return settings, diagnosis
    for number, noise in enumerate(noises, start=1):
        noisier = noise.settings(settings)
        again = diagnosis if noise == SparseNoise() else diagnose(log, noisier, ledger, progress)
        if lead >= _SURE and number == len(noises):
            again = again.without(DISAGREE)
        if again.spoilt:
            continue
        if noise == SparseNoise():
            return settings, again
        message = (
            f"the boxes agree only with {noise.in_words(settings)}, far more than the settings say. The map was made "
            "with this noise. If you know the noise, set localization.xy, depth.sigma_per_m and rays.pixel_sigma"
        )
        return noisier, again.with_findings([Finding(NOISIER, message, spoils=False)])
    return settings, diagnosis


def sparse_noise(log: Log, settings: Settings, progress: Progress) -> tuple[tuple[SparseNoise, ...], float]:
    """Return the noise of a log's places, depths and boxes with which its boxes show objects at the given poses.

    Also return the lead, in log odds, of the log as it is over the log with turned cameras. Several noises may be about as
    likely as the likeliest one. Among them, the one with the noisiest places comes first. The others follow, with the
    likeliest first. The tuple is empty if no noise explains most of the boxes far better than chance and than the noise in
    the settings. Only noise that the settings let a run estimate is changed. Without depths, only the noise in the settings
    is tried, because with noisy places bearings meet anywhere.
    """
    part = middle(log)
    places, depths, boxes = _unknown(part, settings)
    tried = product(_PLACES if places else (1.0,), _RANGES if depths else (1.0,), _RAYS if boxes else (1.0,))
    noises = [SparseNoise(*factors) for factors in tried]
    searched = []
    for number, noise in enumerate(noises):
        progress("noise of few boxes", number, len(noises))
        searched.append(search_objects(part, settings, noise))
    best = max(searched, key=lambda one: one.value)
    nominal = best is searched[0]
    grown = best.found.chance - (0.0 if nominal else searched[0].found.chance)
    if best.value == -np.inf or grown < _CLEAR or best.views > _MOST_VIEWS:
        return (), 0.0
    lead = np.inf
    for corrected, turned in _what_ifs(part, lambda done, total: progress("possible corrections of the input", done, total)):
        ahead = best.value - search_objects(corrected, settings, best.noise).value
        lead = min(lead, ahead) if turned else lead
        if ahead < (_LEAD if turned else -_BETTER):
            return (), 0.0
    if nominal or not places:
        return (best.noise,), lead
    # The first search hardly distinguishes noises. So each noise of places that is about as likely is a start.
    near = [one for one in sorted(searched, key=lambda one: one.value) if one.value > best.value - _NEAR]
    starts = {one.noise.place: one for one in near}
    found = [each for one in starts.values() for each in _settled(part, settings, one, (places, depths, boxes))]
    found = [one for one in found if one.noise.place >= _NOISY] or found
    found.sort(key=lambda one: -one.value - gain_of_shared_places(one))
    evidence = [one.value + gain_of_shared_places(one) for one in found]
    # Among noises that are about as likely, the one with the noisiest places gives the largest sigmas.
    about = [one.noise for one, value in zip(found, evidence, strict=True) if value > evidence[0] - _LEAD]
    noisiest = max(about, key=lambda one: one.place)
    return (noisiest, *[one.noise for one in found[:_OTHERS] if one.noise != noisiest]), lead


def _settled(part: Log, settings: Settings, searched: Searched, unknown: tuple[bool, bool, bool]) -> list[Searched]:
    """Search objects in a part of a log, and estimate the noise from their residuals. Both steps alternate.

    Return the result of each search, because the noise of boxes may grow until it replaces the noise of places. A search
    with too little noise leaves out the rays that miss by much. So the first estimate gives each ray an error of its own,
    and the noise becomes rather too large than too small. The next search then finds the errors of the places. unknown:
    whether the noise of places, depths and boxes is estimated.
    """
    prior = settings.noise.prior
    noise = noise_of_residuals(searched, (True, False, False), prior, shared=False)
    turns = [search_objects(part, settings, noise, correct_places=True)]
    for _ in range(_SETTLED if len(turns[0].found.ray) else 0):
        noise = noise_of_residuals(turns[-1], unknown, prior, shared=True)
        turns.append(search_objects(part, settings, noise, correct_places=True))
        if not len(turns[-1].found.ray):
            break
    return turns[1:] or turns


def _turned_cameras(log: Log, settings: Settings, progress: Progress) -> Finding | None:
    """Return a finding if the objects have far more evidence with all cameras turned about the vertical axis.

    The settings have much noise here. Other checks compare single rays, and with much noise, rays meet anywhere. The result
    is None if objects have many boxes.
    """
    part, tried = middle(log), range(0, 360, _TURN)
    values = []
    for number, degrees in enumerate(tried):
        progress("possible turns of the cameras", number, len(tried))
        searched = search_objects(with_headings(part, degrees), settings, SparseNoise())
        if searched.views > _MOST_VIEWS:
            return None
        values.append(searched.value)
    best = int(np.argmax(values))
    if values[best] < max(values[0], 0.0) + _BETTER:
        return None
    degrees = (tried[best] + 180) % 360 - 180
    message = (
        f"with the cameras turned by about {degrees} degrees about the vertical axis, the boxes agree far better: look at "
        "the yaw of base_T_camera, and at the headings of the poses"
    )
    return Finding("cameras turned", message, basis="boxes")


def _unknown(log: Log, settings: Settings) -> tuple[bool, bool, bool]:
    """Return whether the noise of places, of depths, and of boxes is unknown, and can be found."""
    usual, told = Settings(), any(one.camera.depth_noise is not None for one in log.cameras)
    ranged = any(one.detections is not None and np.isfinite(one.detections.depths).any() for one in log.cameras)
    known = {
        "localization": settings.localization == usual.localization,
        "ranges": settings.depth == usual.depth and not told,
        "rays": settings.rays == usual.rays,
    }
    uses = {name: getattr(settings.noise, name) for name in known}
    places, depths, boxes = (ranged and bool(known[name] if use == "auto" else use) for name, use in uses.items())
    return places, depths, boxes


def _what_ifs(log: Log, progress: Callable[[int, int], None]) -> Iterator[tuple[Log, bool]]:
    """Yield changed copies of a log: with all cameras turned about the vertical axis, or with one usual mistake corrected.

    Each copy comes with a flag that says whether its cameras are turned. Only mistakes about directions are tried. Wrong
    clocks and wrong sizes of images are left out, because they move rays by little, or move all places in the same way.
    """
    usual = [one for one in coarse_hypotheses(log) if one.usual]
    turns = range(_TURN, 360, _TURN)
    for number, degrees in enumerate(turns):
        progress(number, len(usual) + len(turns))
        yield with_headings(log, degrees), True
    for number, hypothesis in enumerate(usual):
        progress(len(turns) + number, len(usual) + len(turns))
        yield hypothesis.put_right(log), False
