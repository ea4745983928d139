"""The radio channel of a backscatter link: line of sight, image sources of planes, single reflections off scatterers.

One way, h = sum_i a_i exp(-2j pi f d_i / c) over the paths i from the antenna to the tag; there and back over the same
antenna, H = h^2. Every function takes one tag, antenna and carrier: `jax.vmap` for more. All are differentiable.

Float32 suffices: paths are counted in wavelengths, and whole wavelengths are taken off exactly before any angle is
formed. At 10 m (30 wavelengths) the roundings of carrier, distance and product leave at most 1e-4 rad there and back.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ...core.numerics import SPEED_OF_LIGHT_M_S, safe_atan2, safe_divide, safe_norm, safe_sqrt, wrap_to_pi
from ...radio.reader import RSSI_AT_1M_DBM
from .environment import Environment, Planes, Scatterers

MIN_DISTANCE_M = 0.05
"""Amplitudes stop growing below this: lambda / (2 pi), where the far field of a UHF antenna begins."""

EDGE_M = 0.1
"""Width over which a reflection fades at the edge of its rectangle. A hard edge would cause phase jumps and have no
gradient; diffraction fades it over a Fresnel zone, 0.3 m and more, so 0.1 m is still rather sharp."""

NULL_DB = 20.0
"""RSSI loss of a tag whose dipole points at the antenna (null of a dipole in a room: up to 20 dB)."""

BEAM_POWER = 7.3
BACK_DB = 20.0
"""A reader's patch antenna of 9 dBic: gain cos^(2 * BEAM_POWER)(angle / 2), half at 35 degrees off its axis, and
`BACK_DB` less behind (assumed). Gain and beam width are consistent: the directivity is BEAM_POWER + 1, 9.2 dB."""

REFLECTION = (0.3, 0.8)
"""Sizes of reflection coefficients of 2 to 6 images that give the phase ripple of the logs (0.13 to 0.23 rad)."""

NO_SIGNAL_DBM = -200.0
"""RSSI where no path remains: far below any receiver's sensitivity, and finite."""


def _phasor(path_m: Float[Array, "*shape"], carrier_hz: Float[Array, ""]) -> Complex[Array, "*shape"]:
    """exp(-2j pi f d / c). Whole wavelengths are subtracted first: that is exact, while rounding a large angle is not."""
    wavelengths = path_m * (carrier_hz / SPEED_OF_LIGHT_M_S)
    angle = -2 * jnp.pi * wrap_to_pi(wavelengths, 1.0)
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _unit(x: Array) -> Array:
    return safe_divide(x, jnp.broadcast_to(safe_norm(x)[..., None], x.shape))


def dipole_amplitude(ray: Float[Array, "*paths 3"], dipole: Float[Array, " 3"]) -> Float[Array, "*paths"]:
    """Field factor of a half-wave dipole for rays that arrive along `ray` (any length), 1 at broadside.

    g^2 = e^2 + (1 - e^2) [cos(pi/2 cos t) / sin t]^2, t the angle between ray and dipole (Balanis, Antenna Theory,
    ch. 4), with e^4 = -`NULL_DB`: rooms and bent antennas fill the null. A zero `dipole` is isotropic.
    """
    lean = jnp.clip(_dot(_unit(ray), jnp.broadcast_to(dipole, ray.shape)), -1.0, 1.0)
    pattern = safe_divide(jnp.cos(0.5 * jnp.pi * lean) ** 2, 1.0 - lean * lean)
    floor = 10.0 ** (-NULL_DB / 20)
    return safe_sqrt(floor + (1.0 - floor) * pattern)


def patch_amplitude(ray: Float[Array, "*paths 3"], boresight: Float[Array, " 3"]) -> Float[Array, "*paths"]:
    """Field factor of the reader's patch antenna for rays that leave along `ray` (any length), 1 on its axis.

    g^2 = b + (1 - b) cos^(2 `BEAM_POWER`)(t / 2), t the angle between ray and the unit vector `boresight`, b = -`BACK_DB`.
    A zero `boresight` is isotropic.
    """
    ahead = _dot(_unit(ray), jnp.broadcast_to(boresight, ray.shape))
    # A tag at the antenna itself has no direction: treated as ahead, which keeps 0^p out of the gradient.
    isotropic = (_dot(boresight, boresight) == 0) | ~jnp.any(ray != 0, axis=-1)
    half_angle = jnp.where(isotropic, 1.0, jnp.clip(0.5 * (1.0 + ahead), 1e-6, 1.0))
    floor = 10.0 ** (-BACK_DB / 10)
    return safe_sqrt(floor + (1.0 - floor) * half_angle**BEAM_POWER)


def plane_paths(
    tag_m: Float[Array, " 3"], antenna_m: Float[Array, " 3"], planes: Planes
) -> tuple[Float[Array, "planes 3"], Float[Array, " planes"]]:
    """Rays from the antenna's mirror images to the tag, metres, and the fraction of each that its rectangle reflects.

    The image of a in the plane n . x = b is a - 2 (n . a - b) n (Allen and Berkley, 1979); its path is the reflected
    one. There is no reflection where antenna and tag lie on different sides.
    """
    side_antenna = _dot(planes.normal, antenna_m[None] - planes.centre_m)
    side_tag = _dot(planes.normal, tag_m[None] - planes.centre_m)
    image = antenna_m[None] - 2 * side_antenna[:, None] * planes.normal
    ray = tag_m[None] - image
    fraction = safe_divide(side_antenna, side_antenna + side_tag)
    hit = image + fraction[:, None] * ray - planes.centre_m
    across = jnp.cross(planes.normal, planes.along)
    place = jnp.abs(jnp.stack([_dot(hit, planes.along), _dot(hit, across)], axis=-1))
    inside = jnp.prod(jax.nn.sigmoid((planes.half_size_m - place) / EDGE_M), axis=-1)
    return ray, jnp.where(side_antenna * side_tag > 0, inside, 0.0)


def scatter_points(
    tag_m: Float[Array, " 3"], antenna_m: Float[Array, " 3"], scatterers: Scatterers
) -> Float[Array, "scatterers 3"]:
    """The reflection point of each scatterer, metres: the point of the shortest path (Fermat).

    On a cylinder's axis by unfolding: heights weighted by the other end's distance from the axis; then moved to the
    surface along the bisector of the two rays, which is exact at equal distances and accurate far away.
    """
    axis, centre = scatterers.axis, scatterers.position_m
    height, across = [], []
    for end in (antenna_m, tag_m):
        offset = end[None] - centre
        height.append(_dot(offset, axis))
        across.append(safe_norm(offset - height[-1][:, None] * axis))
    best = safe_divide(height[0] * across[1] + height[1] * across[0], across[0] + across[1])
    best = jnp.clip(best, -scatterers.half_length_m, scatterers.half_length_m)
    point = centre + best[:, None] * axis
    bisector = _unit(_unit(antenna_m[None] - point) + _unit(tag_m[None] - point))
    return point + scatterers.radius_m[:, None] * bisector


def one_way_gain(
    tag_m: Float[Array, " 3"],
    antenna_m: Float[Array, " 3"],
    carrier_hz: Float[Array, ""],
    environment: Environment,
    *,
    transmission: Float[Array, ""] | float = 1.0,
    dipole: Float[Array, " 3"] | None = None,
    boresight: Float[Array, " 3"] | None = None,
) -> Complex[Array, ""]:
    """Complex gain of the link antenna to tag, relative to free space at 1 m.

    h = g0 s exp(-j k d) / d + sum_p g_p R_p w_p exp(-j k d_p) / d_p + sum_q g_q R_q exp(-j k (u_q + v_q)) / D_q,
    k = 2 pi f / c: line of sight with the caller's `transmission` s (ratio of fields one way: 0 blocked, 10^(-dB/20)
    behind an absorber); image sources p; scatterers q with u, v to antenna and tag and D = u + v + u v / sqrt(rcs / 4 pi).
    The last is the geometrical optics of a sphere: far away the radar equation (Skolnik, ch. 1), close up a mirror's
    1 / (u + v), so that a tag on a body is not drowned by it. g is `dipole_amplitude` at the tag times `patch_amplitude` at
    the antenna, each 1 where its axis is None. First reflections only, and they are not blocked. 1 / d ends at
    `MIN_DISTANCE_M`.
    """
    real = tag_m.dtype
    paired = jnp.complex64 if real == jnp.float32 else jnp.complex128
    environment = jax.tree.map(lambda x: x.astype(paired if jnp.iscomplexobj(x) else real), environment)
    planes, scatterers = environment.planes, environment.scatterers
    axis = jnp.zeros(3, real) if dipole is None else dipole
    ahead = jnp.zeros(3, real) if boresight is None else boresight

    direct = tag_m - antenna_m
    mirrored, inside = plane_paths(tag_m, antenna_m, planes)
    point = scatter_points(tag_m, antenna_m, scatterers)
    out_m, back_m = safe_norm(point - antenna_m[None]), safe_norm(tag_m[None] - point)
    reach_m = safe_sqrt(scatterers.rcs_m2 / (4 * jnp.pi))
    spread_m = out_m + back_m + safe_divide(out_m * back_m, reach_m)

    arriving = jnp.concatenate([direct[None], mirrored, tag_m[None] - point])
    unmirrored = mirrored - 2 * _dot(planes.normal, mirrored)[:, None] * planes.normal
    leaving = jnp.concatenate([direct[None], unmirrored, point - antenna_m[None]])
    path_m = jnp.concatenate([safe_norm(direct)[None], safe_norm(mirrored), out_m + back_m])
    spread_m = jnp.concatenate([safe_norm(direct)[None], safe_norm(mirrored), spread_m])
    strength = jnp.concatenate([jnp.asarray(transmission, real)[None], inside, jnp.where(reach_m > 0, 1.0, 0.0)])
    factor = jnp.concatenate([jnp.ones(1, paired), planes.reflection, scatterers.reflection])
    pattern = dipole_amplitude(arriving, axis) * patch_amplitude(leaving, ahead)
    amplitude = strength * pattern / jnp.maximum(spread_m, MIN_DISTANCE_M)
    return jnp.sum(amplitude.astype(paired) * factor * _phasor(path_m, carrier_hz))


def two_way_gain(one_way: Complex[Array, "*batch"]) -> Complex[Array, "*batch"]:
    """Gain there and back over one antenna: h^2, as the link is reciprocal."""
    return one_way * one_way


def reported_phase_rad(two_way: Complex[Array, "*batch"], *, phase_sign: int = 1) -> Float[Array, "*batch"]:
    """Phase as a reader reports it, in [0, 2 pi), before its offset: -arg H, which grows with distance (Impinj).

    `phase_sign` -1 for readers that report the opposite. 0 where there is no signal.
    """
    angle = phase_sign * -safe_atan2(two_way.imag, two_way.real)
    return jnp.where(angle < 0, angle + 2 * jnp.pi, angle)


def rssi_from_gain_dbm(
    two_way: Complex[Array, "*batch"], *, at_1m_dbm: Float[Array, ""] | float = RSSI_AT_1M_DBM
) -> Float[Array, "*batch"]:
    """RSSI, dBm: 20 log10 |H| + `at_1m_dbm`, the value in free space at 1 m (power, gains, chip).

    In free space it falls by 40 dB per decade. The minimum is `NO_SIGNAL_DBM`, where the gradient is 0.
    """
    magnitude = safe_sqrt(two_way.real**2 + two_way.imag**2)
    smallest = 10.0 ** (-9)
    return jnp.maximum(20 * jnp.log10(jnp.maximum(magnitude, smallest)) + at_1m_dbm, NO_SIGNAL_DBM)
