"""The covariance of a pose that is weakly determined: by the likelihood along its valley, not at the bottom alone.

Where few rods show, the poses that explain a slice about as well lie along a valley that is longer or shorter than the
curvature at its bottom tells, and bent. The valley is walked to both sides until nothing of the likelihood is left;
across it, the likelihood is taken to be Gaussian at each step (Laplace's method). The second moments of that about the
maximum-likelihood pose, all poses being equally likely beforehand, are the covariance; of a straight valley they are
the inverse of the information.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.solvers.maximum_likelihood import Evaluated, evaluate

# A turn counts as what it moves at this distance: units in which directions of position and rotation can be compared.
ARM_MM = 50.0
UNITS = np.array([1.0, 1.0, 1.0, ARM_MM, ARM_MM, ARM_MM])
# The first step, of a standard deviation along the valley; each next one is longer, and corrections bring it back
# to the valley's floor. Where chi-square has risen so far, less than a thousandth of the likelihood is left.
_FIRST_STEP, _LENGTHENED, _CORRECTIONS, _STEPS = 0.4, 1.1, 3, 24
_RISE = 16.0
_FLOOR = 1e-12


def covariance_along_valley(
    frame: Frame,
    slice_from_frame: Pose,
    lines: NDArray[np.intp],
    spots_mm: Array,
    whitening: Array,
    common: Array | None = None,
) -> Array:
    """Covariance (6, 6) of slice_from_frame (mm, rad; see `Pose.perturbed`), which is the maximum-likelihood solution.

    spots_mm (k, 2), whitening (k, 2, 2) 1/mm: of the given rods (k,); whitening turns a residual in mm into one of unit
    variance; common (k, 2, c) mm: errors that all spots share, as in `maximum_likelihood.refine`.
    """
    rotation, translation = slice_from_frame.rotation, slice_from_frame.translation
    target, used = np.zeros((2, len(frame), 2)), np.zeros((2, len(frame)), dtype=bool)
    weights = np.zeros((2, len(frame), 2, 2))
    target[:, lines], used[:, lines], weights[:, lines] = spots_mm, True, whitening
    shared = None
    if common is not None:
        shared = np.zeros((2, len(frame), *common.shape[1:]))
        shared[:, lines] = common

    def at(rotations: Array, translations: Array) -> Evaluated:
        return evaluate(frame, rotations, translations, target, used, weights, shared)

    state = at(np.stack([rotation, rotation]), np.stack([translation, translation]))
    lowest = state.chi_square
    values, vectors = np.linalg.eigh(_in_units(state.information[0]))
    along = np.stack([vectors[:, 0], -vectors[:, 0]])  # the two sides are walked at once
    across, log_volume = _across(_in_units(state.information), along)
    step_mm = _FIRST_STEP / np.sqrt(max(values[0], 1e-12))
    moved = [np.zeros((2, 6))]  # from the solution, by the steps
    log_likelihood, covariance_across = [np.zeros(2)], [across]
    rotations, translations, walking = state.rotations, state.translations, np.array([True, True])
    for _ in range(_STEPS):
        rotations, translations = _moved(rotations, translations, step_mm * along)
        for _ in range(_CORRECTIONS):
            state = at(rotations, translations)
            rotations, translations = _moved(rotations, translations, _to_floor(state, along, 2 * step_mm))
        state = at(rotations, translations)
        information = _in_units(state.information)
        # A rod may come to lie within the slice: no likelihood is left there.
        walking &= np.isfinite(information).all(axis=(1, 2)) & (state.chi_square - lowest < _RISE)
        information = np.where(walking[:, None, None], information, np.eye(6))
        weakest = np.linalg.eigh(information)[1][:, :, 0]
        along = weakest * np.where((weakest * along).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        across, volume = _across(information, along)
        turned = Rotation.from_matrix(rotations @ rotation.T).as_rotvec()
        moved.append(np.concatenate([translations - translation, ARM_MM * turned], axis=1))
        log_likelihood.append(np.where(walking, volume - log_volume - 0.5 * (state.chi_square - lowest), -np.inf))
        covariance_across.append(across)
        if not walking.any():
            break
        step_mm *= _LENGTHENED
    places = np.array(moved)  # (steps, 2, 6)
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=2)
    shares = np.zeros(places.shape[:2])
    shares[:-1] += lengths
    shares[1:] += lengths
    shares *= np.exp(np.array(log_likelihood))
    moments = np.where(shares[..., None, None] > 0, places[..., :, None] * places[..., None, :] + covariance_across, 0)
    mean = np.einsum("ks,ksij->ij", shares, moments) / shares.sum()
    covariance: Array = mean / np.outer(UNITS, UNITS)
    return covariance


def _in_units(information: Array) -> Array:
    return information / np.outer(UNITS, UNITS)


def _moved(rotations: Array, translations: Array, steps: Array) -> tuple[Array, Array]:
    """Poses (2, 3, 3), (2, 3) mm after steps (2, 6) mm."""
    return rotation_exp(steps[:, 3:] / ARM_MM) @ rotations, translations + steps[:, :3]


def _across(information: Array, along: Array) -> tuple[Array, Array]:
    """Covariance (2, 6, 6) mm^2 of what is at right angles to `along` (2, 6), and the logarithm (2,) of its volume."""
    line = along[:, :, None] * along[:, None, :]
    rest = np.eye(6) - line
    # The floor is for directions that nothing determines at all.
    size = np.einsum("sii->s", information)[:, None, None]
    whole = rest @ information @ rest + line + _FLOOR * size * np.eye(6)
    return rest @ np.linalg.inv(whole) @ rest, -0.5 * np.linalg.slogdet(whole)[1]


def _to_floor(state: Evaluated, along: Array, longest_mm: float) -> Array:
    """Steps (2, 6) mm at right angles to `along` that lead down to the valley's floor; none where there is no way."""
    line = along[:, :, None] * along[:, None, :]
    rest = np.eye(6) - line
    information, gradient = _in_units(state.information), state.gradient / UNITS
    known = np.isfinite(information).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
    information = np.where(known[:, None, None], information, np.eye(6))
    gradient = np.where(known[:, None], gradient, 0.0)
    size = np.einsum("sii->s", information)[:, None, None]
    held = rest @ information @ rest + size * (line + _FLOOR * np.eye(6))
    steps = np.linalg.solve(held, (rest @ gradient[..., None]))[..., 0]
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    shortened: Array = steps * np.minimum(1.0, longest_mm / np.maximum(lengths, 1e-12))
    return shortened
