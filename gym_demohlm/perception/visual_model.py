"""A compiled scene -> depth and geom ids of the head camera from one pass of the graphics library, quickly on a CPU.

Drawing in software is bound by vertices, and the robot's meshes have most of them. So this draws a copy of the model
whose mesh vertices are clustered in cells of 1 cm, leaves out geoms outside the picture, and may draw a window of the
image only: the same pixels as in the whole image. It does no more of MuJoCo's position stage than forward kinematics.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.perception.camera import Intrinsics, Window, head_intrinsics, whole
from gym_demohlm.scene.shapes import Shapes

CELL = 0.010  # m, edge of the cells in which vertices are clustered
_DRAWN_GROUPS = 3  # MuJoCo draws geom groups 0, 1 and 2
_HIDDEN_GROUP = 5
_MAX_GEOMS = 4000


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What one pass gives.

    Attributes:
        depth: (height, width) float32, distance along the optical axis [m].
        ids: (height, width) int32, the geom seen in each pixel, -1 for none.
        window: Where in the whole image it lies.
    """

    depth: np.ndarray
    ids: np.ndarray
    window: Window


def cluster_vertices(model: mujoco.MjModel, cell: float = CELL) -> int:
    """Merge the vertices of every mesh that share a cell of a grid, in place; faces that lose a corner go.

    Args:
        model: A copy for drawing only: what touches keeps its own geometry elsewhere.
        cell: Edge of the grid's cells [m].

    Returns:
        How many faces are left.
    """
    kept_faces = 0
    has_texture = model.mesh_facetexcoord.shape[0] == model.mesh_face.shape[0]
    for mesh in range(model.nmesh):
        vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        cells = np.floor(model.mesh_vert[vertices] / cell).astype(np.int64)
        _, kept, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        faces = kept[inverse.reshape(-1)][model.mesh_face[first : first + count]]
        a, b, c = faces.T
        whole_faces = np.flatnonzero((a != b) & (b != c) & (a != c))
        _, unique = np.unique(np.sort(faces[whole_faces], axis=1), axis=0, return_index=True)
        chosen = np.sort(whole_faces[unique])
        if len(chosen) == 0:
            kept_faces += count
            continue  # smaller than a cell: it stays as it is
        after = slice(first, first + len(chosen))
        model.mesh_facenormal[after] = model.mesh_facenormal[first + chosen]
        if has_texture:
            model.mesh_facetexcoord[after] = model.mesh_facetexcoord[first + chosen]
        model.mesh_face[after] = faces[chosen]
        model.mesh_facenum[mesh] = len(chosen)
        kept_faces += len(chosen)
    return kept_faces


class VisualModel:
    """Draws a scene as its head camera sees it; the graphics context is made at once.

    Args:
        model: The compiled scene; it is copied.
        intrinsics: The camera; the head's D435 by default.
        cell: See ``cluster_vertices``; 0 keeps all vertices.
        camera: Name of the camera in the scene.
        geoms: (n,) which geoms the shapes are of that ``wear`` is given; all by default.

    Attributes:
        model: The copy that is drawn.
        data: Its state, see ``place``.
        intrinsics: The camera.

    Raises:
        SceneError: This machine has nothing to draw with, or the image is larger than the scene's image buffer.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        intrinsics: Intrinsics | None = None,
        cell: float = CELL,
        camera: str = "head",
        geoms: np.ndarray | None = None,
    ) -> None:
        self.intrinsics = intrinsics or head_intrinsics()
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        if cell > 0:
            cluster_vertices(self.model, cell)
        limit, size = model.vis.global_, (self.intrinsics.width, self.intrinsics.height)
        if size[0] > limit.offwidth or size[1] > limit.offheight:
            raise SceneError(f"an image of {size}", f"at most {limit.offwidth}x{limit.offheight}", "ask for less")
        self._groups = self.model.geom_group.copy()
        self._worn: Shapes | None = None
        self._geoms: np.ndarray | slice = slice(None) if geoms is None else geoms
        self._bounded = self.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._camera.fixedcamid = self.model.camera(camera).id
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self.model, _MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._closed = False
        self._open(*size)

    def _open(self, width: int, height: int) -> None:
        try:
            self._gl = mujoco.GLContext(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except Exception as error:  # each backend fails in its own way
            raise SceneError(
                f"no graphics to draw with ({error})",
                "EGL or OSMesa",
                "install them (Debian: libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl",
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value

    def wear(self, shapes: Shapes) -> None:
        """Draw a world of these shapes from now on, see ``Scene.shapes``."""
        if shapes is not self._worn:
            self._worn = shapes
            shapes.put_on(self.model, self._geoms)

    def place(self, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> None:
        """Bring bodies, camera and lights where a state has them.

        Args:
            qpos: (nq,).
            mocap_pos: (nmocap, 3) [m].
            mocap_quat: (nmocap, 4) wxyz.
        """
        self.data.qpos[:] = qpos
        self.data.mocap_pos[:], self.data.mocap_quat[:] = mocap_pos, mocap_quat
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def drawn(self) -> np.ndarray:
        """Which geoms (ngeom,) are drawn at all; those that only collide are not."""
        return self._groups < _DRAWN_GROUPS

    def camera_pose(self) -> np.ndarray:
        """Return ``T_world_optical`` (4, 4), the pose of the frame ``optical`` in the world, after ``place``."""
        camera = self._camera.fixedcamid
        T = np.eye(4)
        T[:3, 3] = self.data.cam_xpos[camera]
        T[:3, :3] = self.data.cam_xmat[camera].reshape(3, 3) * np.array([1.0, -1.0, -1.0])  # MuJoCo: y up, -z forward
        return T

    def depth_and_ids(self, window: Window | None = None, hidden: Sequence[int] | np.ndarray = ()) -> Frame:
        """Draw depth and ids in one pass.

        Args:
            window: Part of the image; all of it by default.
            hidden: Geoms that are left out.
        """
        window = window or whole(self.intrinsics)
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        colors = np.empty((window.height, window.width, 3), np.uint8)
        depth = np.empty((window.height, window.width), np.float32)
        self._draw(window, hidden, colors, depth)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        code = colors[..., 0].astype(np.int32)
        code |= colors[..., 1].astype(np.int32) << 8  # there are fewer than 65536 geoms
        return Frame(depth=self._metres(depth)[::-1], ids=self._geom_of_code()[code[::-1]], window=window)

    def rgb(self, window: Window | None = None) -> np.ndarray:
        """Draw a colour image (height, width, 3) uint8 of the window; the whole image by default."""
        window = window or whole(self.intrinsics)
        colors = np.empty((window.height, window.width, 3), np.uint8)
        self._draw(window, (), colors, None)
        return colors[::-1]

    def rgb_and_depth(self) -> tuple[np.ndarray, np.ndarray]:
        """Draw the whole image's colours (height, width, 3) uint8 and depth (height, width) float32 [m].

        They are those of ``rgb`` and ``depth_and_ids``, but for the depth of the sky, which is farther than all things.
        One pass gives both, unless something that is drawn is transparent: colours leave its depth out in part.
        """
        window = whole(self.intrinsics)
        if self._transparent():
            return self.rgb(), self.depth_and_ids().depth
        colors = np.empty((window.height, window.width, 3), np.uint8)
        depth = np.empty((window.height, window.width), np.float32)
        self._draw(window, (), colors, depth)
        return colors[::-1], self._metres(depth)[::-1]

    def _transparent(self) -> bool:
        """Tell whether a geom that may be drawn lets light through."""
        model = self.model
        opacity = np.append(model.mat_rgba[:, 3], 1.0)[model.geom_matid]  # of no material: the last
        partly = [(0.0 < alpha) & (alpha < 1.0) for alpha in (model.geom_rgba[:, 3], opacity)]
        return bool((np.logical_or(*partly) & self.drawn).any())

    def _draw(
        self, window: Window, hidden: Sequence[int] | np.ndarray, colors: np.ndarray, depth: np.ndarray | None
    ) -> None:
        self._gl.make_current()
        groups = self.model.geom_group
        groups[:] = np.where(self._outside(window), _HIDDEN_GROUP, self._groups)
        if len(hidden):
            groups[hidden] = _HIDDEN_GROUP
        mujoco.mjv_updateScene(
            self.model, self.data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        self._aim(window)
        rectangle = mujoco.MjrRect(0, 0, window.width, window.height)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(colors, depth, rectangle, self._context)

    def _aim(self, window: Window) -> None:
        """Turn the frustum of both eyes to the window."""
        camera = self.intrinsics
        for eye in self._scene.camera:
            scale = eye.frustum_near / camera.focal
            eye.frustum_top = -(window.top - 0.5 - camera.center_v) * scale
            eye.frustum_bottom = -(window.top + window.height - 0.5 - camera.center_v) * scale
            eye.frustum_center = (window.left + (window.width - 1) / 2.0 - camera.center_u) * scale

    def _outside(self, window: Window) -> np.ndarray:
        """Return which geoms (ngeom,) lie wholly outside the window's pyramid, by their bounding boxes."""
        camera, frames = self.intrinsics, self.data.geom_xmat.reshape(-1, 3, 3)
        right = (window.left + window.width - 0.5 - camera.center_u) / camera.focal
        left = (window.left - 0.5 - camera.center_u) / camera.focal
        bottom = (window.top + window.height - 0.5 - camera.center_v) / camera.focal
        top = (window.top - 0.5 - camera.center_v) / camera.focal
        outward = np.array([[1, 0, -right], [-1, 0, left], [0, 1, -bottom], [0, -1, top], [0, 0, -1]])
        T_world_optical = self.camera_pose()
        outward = outward @ T_world_optical[:3, :3].T
        middle, half = self.model.geom_aabb[:, :3, None], self.model.geom_aabb[:, 3:, None]
        centers = self.data.geom_xpos + (frames @ middle)[..., 0] - T_world_optical[:3, 3]
        reach = (np.abs(outward @ frames) @ half)[..., 0]
        return (centers @ outward.T > reach).any(axis=1) & self._bounded

    def _geom_of_code(self) -> np.ndarray:
        """Return the geom of each colour code; code 0 is the background."""
        found = np.full(self._scene.ngeom + 1, -1, np.int32)
        for drawn in self._scene.geoms[: self._scene.ngeom]:
            if drawn.segid >= 0 and drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                found[drawn.segid + 1] = drawn.objid
        return found

    def _metres(self, buffer: np.ndarray) -> np.ndarray:
        """Return the distances [m] that a depth buffer with 0 at the far plane stands for."""
        extent, planes = self.model.stat.extent, self.model.vis.map
        far, near = np.float32(planes.zfar * extent), np.float32(planes.znear * extent)
        # The far plane's distance is what float64 makes of the float32 matrix that the graphics library is given.
        c = np.float32(-0.5) * (-(far + near) / (far - near)) - np.float32(0.5)
        d = np.float32(-0.5) * (-(np.float32(2) * far * near) / (far - near))
        return (np.float64(d) / (buffer + np.float64(c))).astype(np.float32)

    def close(self) -> None:
        """Give the graphics context back."""
        if not self._closed:
            self._closed = True
            self._gl.make_current()
            self._context.free()
            self._gl.free()
