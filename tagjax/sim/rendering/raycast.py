"""Ray casting of a world, as a MuJoCo model that is posed at any time. Needs the `sim` extra.

Static bodies are cast once per viewpoint; later frames cast only the rays that may hit moving bodies.
"""

# MuJoCo's names come from a compiled module that the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import SupportsFloat

import numpy as np

from ...recording import Intrinsics
from ..world.bodies import Body, Material, Shape, World, rotation_matrix
from .hits import Hits
from .viewpoint import Viewpoint, view_key

try:
    import mujoco
except ImportError as error:  # pragma: no cover - depends on the installation
    raise ImportError(
        "Simulated pictures need MuJoCo, which is not installed: pip install 'tagjax[sim]' (or -e '.[sim]' in a clone)."
    ) from error

FAR_M = 60.0
"""Length of the rays: nothing farther away is visible."""

_SHADOW_GAP_M = 0.003
_MAX_VIEWS = 4
_STATIC, _MOVING = (np.array([on, not on, 0, 0, 0, 0], np.uint8) for on in (True, False))


@functools.lru_cache(maxsize=16)
def _lens(k: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (pixels, 3) in the camera frame, and the cosine that converts distance into z. Without lens distortion."""
    x, y = np.meshgrid((np.arange(k.width) - k.cx_px) / k.fx_px, (np.arange(k.height) - k.cy_px) / k.fy_px)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=-1)
    cosine = 1 / np.linalg.norm(rays, axis=-1)
    return rays * cosine[:, None], cosine


class Raycaster:
    """A compiled world. MuJoCo numbers its geoms in its own order: see `geom_body`, `geom_label` and `geom_shape`."""

    def __init__(self, world: World):
        world.check()
        self.world = world
        spec = mujoco.MjSpec()
        shapes: dict[str, tuple[int, Shape]] = {}
        movers = [body for body in world.bodies if body.poses.moves]
        for number, body in enumerate(world.bodies):
            moves = body.poses.moves
            owner = spec.worldbody.add_body(mocap=True) if moves else spec.worldbody
            for index, shape in enumerate(body.shapes):
                place, turn = (shape.position_m, shape.quaternion) if moves else _placed(body, shape)
                shapes[f"{number}/{index}"] = (number, shape)
                owner.add_geom(
                    name=f"{number}/{index}",
                    type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}"),
                    size=shape.size_m,
                    pos=place,
                    quat=turn,
                    group=int(moves),
                )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        # MuJoCo puts the world body's geoms first, so the order is not that of the bodies.
        found = [shapes[self.model.geom(index).name] for index in range(self.model.ngeom)]
        self.geom_body = np.array([body for body, _ in found], np.int32)
        self.geom_shape: tuple[Shape, ...] = tuple(shape for _, shape in found)
        self.geom_label = np.array([world.bodies[body].label for body, _ in found], np.uint8)
        self.geom_moves = np.array([world.bodies[body].poses.moves for body, _ in found], bool)
        self._spheres = _bounding_spheres(self.model)
        self._paths = [(body.poses.position_m, body.poses.quaternion) for body in movers]
        self._views: dict[tuple, tuple[np.ndarray, Hits]] = {}
        self._lit: dict[tuple, np.ndarray] = {}
        self.pose(0)

    @property
    def materials(self) -> tuple[Material, ...]:
        """The material of every geom."""
        return tuple(shape.material for shape in self.geom_shape)

    def pose(self, step: SupportsFloat) -> None:
        """Move all bodies to their poses at a step; poses between two steps are interpolated."""
        step = min(max(float(step), 0.0), self.world.num_steps - 1.0)
        self.step = step
        first = int(step)
        part = step - first
        for number, (position, quaternion) in enumerate(self._paths):
            place, turn = position[first], quaternion[first]
            if part > 0:
                after = quaternion[first + 1]
                place = (1 - part) * place + part * position[first + 1]
                turn = (1 - part) * turn + part * (after if turn @ after >= 0 else -after)
            self.data.mocap_pos[number] = place
            self.data.mocap_quat[number] = turn / np.linalg.norm(turn)
        mujoco.mj_kinematics(self.model, self.data)

    def cast(self, view: Viewpoint) -> Hits:
        """Cast one ray per pixel through the world in its present pose."""
        rays, static = self._background(view)
        position, rotation = self.data.geom_xpos.copy(), self.data.geom_xmat.reshape(-1, 3, 3).copy()
        shape = static.geom.shape
        pixels = np.flatnonzero(self._may_move(view))
        geom, distance, normal = self._shoot(view.position_m, rays[pixels], _MOVING)
        depth = distance * _lens(view.intrinsics)[1][pixels]
        behind = static.depth_m.ravel()[pixels]
        nearer = (geom >= 0) & ((depth < behind) | (behind == 0))
        pixels, geom, depth, normal = pixels[nearer], geom[nearer], depth[nearer], normal[nearer]
        world = view.position_m + rays[pixels] * distance[nearer, None]
        local = np.einsum("nji,nj->ni", rotation[geom], world - position[geom])
        moving = np.zeros(shape, bool)
        moving.reshape(-1)[pixels] = True

        def laid_over(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = old.copy()
            out.reshape(moving.size, *old.shape[2:])[pixels] = new
            return out

        return Hits(
            view,
            laid_over(static.geom, geom),
            laid_over(static.depth_m, depth),
            laid_over(static.normal, normal),
            laid_over(static.local_m, local),
            laid_over(static.world_m, world),
            moving,
            position,
            rotation,
        )

    def background(self, view: Viewpoint) -> Hits:
        """The cast of the static bodies alone. Every call returns the same object, so caches may keep it."""
        return self._background(view)[1]

    def labels(self, hits: Hits) -> np.ndarray:
        """Label mask of a cast, uint8 (height, width); 0 is the room, and pixels without a hit."""
        return np.where(hits.geom >= 0, self.geom_label[np.maximum(hits.geom, 0)], 0).astype(np.uint8)

    def lit(self, hits: Hits, light_m: Sequence[float] | np.ndarray) -> np.ndarray:
        """Pixels of a cast of the present pose that a point light reaches, bool (height, width).

        Shadows of moving bodies on static ones are cast at half resolution, and at full resolution near their edges.
        Geoms are convex, so a surface that faces the light is never in its own geom's shadow; hits less than 3 mm before
        the surface cast none.
        """
        light = np.asarray(light_m, float)
        key = (*view_key(hits.view), light.tobytes())
        if key not in self._lit:
            static = self.background(hits.view)
            every = np.arange(static.geom.size)
            _keep(self._lit, key, ~self._shaded(static, every, light, _STATIC).reshape(static.geom.shape))
        lit = self._lit[key].copy()
        if not self.geom_moves.any():
            return lit
        height, width = lit.shape
        grid = np.arange(height * width).reshape(height, width)
        coarse = self._shaded(hits, grid[::2, ::2].ravel(), light, _MOVING).reshape(grid[::2, ::2].shape)
        padded = np.pad(coarse, 1, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        rim = _doubled(np.any(windows, (2, 3)) & ~np.all(windows, (2, 3)), height, width)
        shade = _doubled(coarse, height, width)
        again = np.flatnonzero(rim & ~hits.moving)
        shade.reshape(-1)[again] = self._shaded(hits, again, light, _MOVING)
        lit &= ~shade
        movers = np.flatnonzero(hits.moving)
        lit.reshape(-1)[movers] = ~self._shaded(hits, movers, light, None)
        return lit

    def _background(self, view: Viewpoint) -> tuple[np.ndarray, Hits]:
        key = view_key(view)
        if key not in self._views:
            unit, cosine = _lens(view.intrinsics)
            rays = unit @ view.rotation.T
            shape = (view.intrinsics.height, view.intrinsics.width)
            geom, distance, normal = self._shoot(view.position_m, rays, _STATIC)
            position, rotation = self.data.geom_xpos.copy(), self.data.geom_xmat.reshape(-1, 3, 3).copy()
            hit = geom >= 0
            index = np.maximum(geom, 0)
            world = np.where(hit[:, None], view.position_m + rays * distance[:, None], 0.0)
            local = np.where(hit[:, None], np.einsum("nji,nj->ni", rotation[index], world - position[index]), 0.0)
            static = Hits(
                view,
                geom.reshape(shape),
                np.where(hit, distance * cosine, 0.0).reshape(shape),
                normal.reshape(*shape, 3),
                local.reshape(*shape, 3),
                world.reshape(*shape, 3),
                np.zeros(shape, bool),
                position,
                rotation,
            )
            _keep(self._views, key, (rays, static))
        return self._views[key]

    def _shoot(
        self, origin: np.ndarray, rays: np.ndarray, group: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Geom, distance and normal of the first hit of unit rays (n, 3) from a point."""
        count = len(rays)
        geom, distance, normal = np.full(count, -1, np.int32), np.zeros(count), np.zeros((count, 3))
        if count:
            mujoco.mj_multiRay(
                self.model, self.data, origin, rays.reshape(-1), group, True, -1,
                geom, distance, normal.reshape(-1), count, FAR_M,
            )  # fmt: skip
        return geom, distance, normal

    def _may_move(self, view: Viewpoint) -> np.ndarray:
        """Pixels whose ray may hit a moving geom: those within the rectangle around its bounding sphere."""
        k = view.intrinsics
        mask = np.zeros((k.height, k.width), bool)
        radius = self.model.geom_rbound[self.geom_moves]
        for (x, y, z), r in zip(view.to_camera(self.data.geom_xpos[self.geom_moves]), radius, strict=True):
            if z + r <= 0:
                continue
            if z - r < 0.05:
                mask[:] = True
                break
            edges = []
            for middle, focal, centre, size in ((x, k.fx_px, k.cx_px, k.width), (y, k.fy_px, k.cy_px, k.height)):
                low = min((middle - r) / (z - r), (middle - r) / (z + r)) * focal + centre
                high = max((middle + r) / (z - r), (middle + r) / (z + r)) * focal + centre
                edges.append(slice(int(np.clip(np.floor(low), 0, size)), int(np.clip(np.ceil(high) + 1, 0, size))))
            mask[edges[1], edges[0]] = True
        return mask

    def _shaded(self, hits: Hits, pixels: np.ndarray, light: np.ndarray, group: np.ndarray | None) -> np.ndarray:
        """Whether geoms of a group lie between the light and pixels (flat indices)."""
        own = hits.geom.reshape(-1)[pixels]
        ray = hits.world_m.reshape(-1, 3)[pixels] - light
        # Surfaces that face away from the light are dark without a ray: half of the moving pixels in most pictures.
        faces = (own >= 0) & (np.einsum("ni,ni->n", ray, hits.normal.reshape(-1, 3)[pixels]) < 0)
        faces = np.flatnonzero(faces)
        ray = ray[faces]
        away = np.maximum(np.sqrt(np.einsum("ni,ni->n", ray, ray)), 1e-9)
        ray /= away[:, None]
        if group is _MOVING:
            near = np.flatnonzero(self._may_meet_movers(light, ray))
            faces, ray, away = faces[near], ray[near], away[near]
        geom, distance, _ = self._shoot(light, ray, group)
        shaded = np.zeros(len(pixels), bool)
        shaded[faces] = (geom >= 0) & (distance < away - _SHADOW_GAP_M)
        return shaded

    def _may_meet_movers(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Which unit rays (n, 3) from a point meet the bounding sphere of a moving body; cheaper than casting them."""
        body, centre, radius = self._spheres
        turn = self.data.xmat.reshape(-1, 3, 3)[body]
        toward = self.data.xpos[body] + np.einsum("nij,nj->ni", turn, centre) - origin
        away = np.linalg.norm(toward, axis=1)
        if np.any(away <= radius):
            return np.ones(len(rays), bool)
        # With a margin for the rounding of single precision.
        least = np.sqrt(1 - (radius / away) ** 2) - 1e-5
        cosine = rays.astype(np.float32) @ (toward / away[:, None]).T.astype(np.float32)
        return np.any(cosine >= least.astype(np.float32), axis=1)


def _bounding_spheres(model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index, centre (in the body's frame) and radius of the bounding sphere of every moving body."""
    bodies = np.flatnonzero(model.body_mocapid >= 0)
    centre, radius = np.zeros((len(bodies), 3)), np.zeros(len(bodies))
    for row, body in enumerate(bodies):
        geoms = np.flatnonzero(model.geom_bodyid == body)
        centre[row] = model.geom_pos[geoms].mean(axis=0)
        away = np.linalg.norm(model.geom_pos[geoms] - centre[row], axis=1)
        radius[row] = (away + model.geom_rbound[geoms]).max()
    return bodies, centre, radius


def _placed(body: Body, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """World position and quaternion of a shape of a body that never moves."""
    place, turn = body.poses.at(0)
    quaternion = np.zeros(4)
    mujoco.mju_mulQuat(quaternion, np.asarray(turn, float), np.asarray(shape.quaternion, float))
    return place + rotation_matrix(turn) @ np.asarray(shape.position_m), quaternion


def _doubled(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    return mask.repeat(2, axis=0)[:height].repeat(2, axis=1)[:, :width]


def _keep(cache: dict, key: tuple, value) -> None:
    """Store a value and drop the oldest ones: a moving camera must not fill the memory."""
    while len(cache) >= _MAX_VIEWS:
        cache.pop(next(iter(cache)))
    cache[key] = value
