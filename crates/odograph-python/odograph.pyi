"""Trajectories and maps from one downward camera: metric poses with their covariance.

Lengths are metres, angles radians, times seconds; arrays are numpy's. Images are uint8, H×W (gray)
or H×W×3 (RGB). Whatever goes wrong raises Error with one sentence that says what, where and why.
"""

from collections.abc import Iterable, Sequence
from os import PathLike
from typing import Any, Literal, TypeAlias, TypedDict

import numpy as np
import numpy.typing as npt

_Path: TypeAlias = str | PathLike[str]
_Image: TypeAlias = npt.NDArray[np.uint8]
_Numbers: TypeAlias = npt.NDArray[np.float64]
_Motion: TypeAlias = Literal["auto", "rigid", "similarity", "free", "mean"]
_Lens: TypeAlias = Literal["brown-conrady", "kannala-brandt", "double-sphere"]
_Trajectory: TypeAlias = Trajectory | Simulation | _Path | tuple[npt.ArrayLike, npt.ArrayLike]

__version__: str

class Error(Exception):
    """One sentence that says what failed, where, why, and what to do."""

    kind: Literal["usage", "input", "output"]

class Camera:
    """A calibrated camera.

    K is the 3×3 camera matrix in pixels (pixel centres at integers, no skew), dist the distortion
    coefficients of the model, size the image's (width, height), readout the rolling shutter's time
    from first to last row in seconds (0: global shutter, None: to be learned).
    """

    def __init__(
        self,
        K: npt.ArrayLike,
        dist: npt.ArrayLike | None = None,
        *,
        size: tuple[int, int],
        model: _Lens = "brown-conrady",
        readout: float | None = None,
    ) -> None: ...
    @staticmethod
    def load(path: _Path, size: tuple[int, int] | None = None) -> Camera:
        """The camera of an OpenCV, ROS camera_info, Kalibr, EuRoC or COLMAP file."""
    @staticmethod
    def from_field_of_view(
        size: tuple[int, int], field_of_view: tuple[float, float], height: float
    ) -> Camera:
        """A camera whose image shows field_of_view (metres) of the ground from height metres."""
    def save(self, path: _Path) -> None:
        """Writes OpenCV YAML, which load reads to the bit."""
    @property
    def K(self) -> _Numbers:
        """3×3, pixels."""
    @property
    def dist(self) -> _Numbers: ...
    @property
    def model(self) -> _Lens: ...
    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
    @property
    def readout(self) -> float | None:
        """Seconds."""

class Rig:
    """How a camera is mounted: height above the ground in metres; roll, pitch and yaw against
    straight down with the top of the image forward, radians; where known, the camera's place in
    the robot's frame (x forward, y left, z up), metres. With it poses are the robot's."""

    def __init__(
        self,
        height: float,
        *,
        roll: float = 0.0,
        pitch: float = 0.0,
        yaw: float = 0.0,
        lever_arm: tuple[float, float, float] | None = None,
    ) -> None: ...
    @staticmethod
    def load(path: _Path) -> Rig:
        """The rig of a TOML file with height_m, roll_deg, pitch_deg, yaw_deg and, where known,
        x_m, y_m and z_m."""
    def save(self, path: _Path) -> None: ...
    @property
    def height(self) -> float:
        """Metres."""
    @property
    def roll(self) -> float:
        """Radians."""
    @property
    def pitch(self) -> float:
        """Radians."""
    @property
    def yaw(self) -> float:
        """Radians, counter-clockwise."""
    @property
    def lever_arm(self) -> tuple[float, float, float] | None:
        """Place of the camera in the robot's frame, metres; None where it is not known."""

class Odometry:
    """Visual odometry, one image after the other.

    The mount is height (metres, looking straight down) or rig. Loops are not closed here: run does
    that. With "auto", the shutter's readout time, the tilt and the lens are found on the way, as by
    a live run; the pose may change a little where the readout time becomes known.
    """

    def __init__(
        self,
        camera: Camera | _Path,
        height: float | None = None,
        *,
        rig: Rig | _Path | None = None,
        motion: _Motion = "auto",
        mask: _Image | None = None,
    ) -> None: ...
    def process(self, image: _Image, t: float) -> Frame:
        """The estimate of the next frame, taken at t seconds. Any strides; other threads run
        meanwhile."""
    @property
    def keyframes(self) -> int: ...

class Frame:
    """What odometry says of one frame. World x is forward at the start, y left, z up."""

    @property
    def frame(self) -> int: ...
    @property
    def time(self) -> float:
        """Seconds."""
    @property
    def status(self) -> str:
        """"tracked", or "lost:" and bare, dark, jump, blur, shadow or not-planar."""
    @property
    def tracked(self) -> bool: ...
    @property
    def pose(self) -> _Numbers | None:
        """4×4 transform from camera (with a place on the robot, from robot) to world, metres."""
    @property
    def x(self) -> float | None:
        """Metres."""
    @property
    def y(self) -> float | None:
        """Metres."""
    @property
    def heading(self) -> float | None:
        """Radians, counter-clockwise, not wrapped."""
    @property
    def height(self) -> float | None:
        """Metres above the ground."""
    @property
    def roll(self) -> float | None:
        """Radians."""
    @property
    def pitch(self) -> float | None:
        """Radians."""
    @property
    def velocity(self) -> tuple[float, float, float] | None:
        """Along world x and y, metres per second, and of the heading, radians per second."""
    @property
    def covariance(self) -> _Numbers | None:
        """6×6, of (x, y, heading, height, roll, pitch) relative to the start."""
    @property
    def tracks(self) -> _Numbers:
        """N×4: column and row in this image, and of the corner in the keyframe, pixels."""
    @property
    def inliers(self) -> npt.NDArray[np.bool_]:
        """N: whether each track agrees with the motion."""
    @property
    def residual(self) -> float:
        """Root mean square reprojection error of the inliers, pixels."""
    @property
    def keyframe(self) -> bool: ...
    @property
    def segment(self) -> int:
        """Number of tracking gaps before this frame."""

class Trajectory:
    """The path that a run found, with loops closed. The arrays have a row for each frame with a
    pose; World x is forward at the start, y left, z up."""

    @property
    def timestamps(self) -> _Numbers:
        """N, seconds, strictly increasing."""
    @property
    def poses(self) -> _Numbers:
        """N×4×4 transforms from camera (with a place on the robot, from robot) to world, metres."""
    @property
    def covariances(self) -> _Numbers:
        """N×6×6, of (x, y, heading, height, roll, pitch) relative to the start."""
    @property
    def x(self) -> _Numbers:
        """N, metres."""
    @property
    def y(self) -> _Numbers:
        """N, metres."""
    @property
    def heading(self) -> _Numbers:
        """N, radians, counter-clockwise, not wrapped."""
    @property
    def end(self) -> Literal["completed", "interrupted", "tracking-failed"]: ...
    @property
    def statistics(self) -> dict[str, Any]:
        """The figures of stats.json."""
    @property
    def warnings(self) -> list[str]: ...
    @property
    def folder(self) -> _Path | None:
        """The folder with the results; None where none was asked for."""
    def to_pandas(self) -> Any:
        """A pandas.DataFrame with a row for every frame, by time_s."""
    def to_evo(self) -> Any:
        """An evo PoseTrajectory3D."""
    def __len__(self) -> int: ...

def run(
    source: _Path,
    camera: Camera | _Path | None = None,
    height: float | None = None,
    *,
    rig: Rig | _Path | None = None,
    field_of_view: tuple[float, float] | None = None,
    output: _Path | None = None,
    map: _Path | None = None,
    overwrite: bool = False,
    topic: str | None = None,
    timestamps: _Path | None = None,
    fps: float | None = None,
    start: float | None = None,
    end: float | None = None,
    every: int = 1,
    max_frames: int | None = None,
    gyro: _Path | None = None,
    compass: _Path | None = None,
    wheel: _Path | None = None,
    range_finder: _Path | None = None,
    gyro_topic: str | None = None,
    wheel_topic: str | None = None,
    range_topic: str | None = None,
    motion: _Motion = "auto",
    readout: float | None = None,
    mask: _Path | None = None,
    loops: bool = True,
    threads: int | None = None,
) -> Trajectory:
    """Follows a video, a folder of pictures, a robot recording or an earlier run.toml to its end.

    height is in metres; field_of_view (width, height of the ground in the image, metres) replaces
    camera and height. start, end and readout are seconds.
    """

class Map:
    """A map file, opened for reading only."""

    def __init__(self, path: _Path) -> None: ...
    def localize(self, image: _Image | _Path, *, motion: _Motion = "auto") -> Place:
        """Where a picture, or the end of a recording, was taken in the map."""
    def mosaic(
        self, max_pixels: int = 100_000_000
    ) -> tuple[_Image, tuple[float, float, float, float, float, float]]:
        """The ground as an H×W×4 RGBA array, and GDAL's geotransform, metres."""
    @property
    def camera(self) -> Camera: ...
    @property
    def rig(self) -> Rig: ...
    @property
    def sessions(self) -> list[str]:
        """The recordings that made the map."""
    @property
    def path(self) -> _Path: ...

class Place:
    """Where a camera is in a map, or why that is not known."""

    @property
    def found(self) -> bool: ...
    @property
    def verdict(
        self,
    ) -> Literal["found", "never-seen", "too-few-features", "repeats", "ambiguous"]: ...
    @property
    def message(self) -> str | None:
        """Why nothing was found."""
    @property
    def x(self) -> float | None:
        """Metres."""
    @property
    def y(self) -> float | None:
        """Metres."""
    @property
    def heading(self) -> float | None:
        """Radians in (-π, π], counter-clockwise."""
    @property
    def sd(self) -> tuple[float, float, float] | None:
        """Standard deviations of x and y, metres, and heading, radians."""
    @property
    def frame(self) -> int | None: ...
    @property
    def nearest(self) -> tuple[int, float, int] | None:
        """The nearest keyframe, how far it is in metres, and its session."""
    @property
    def candidates(self) -> list[tuple[float, float, float, float]]:
        """Places that look alike: probability, x and y (metres), heading (radians)."""

class Simulation:
    """A rendered drive: a sequence of uint8 images, H×W or H×W×3, with exact truth."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> _Image: ...
    def save(self, folder: _Path) -> None:
        """Writes frames/, frames.txt, truth.tum, camera.yaml and rig.toml."""
    @property
    def timestamps(self) -> _Numbers:
        """N, seconds."""
    @property
    def poses(self) -> _Numbers:
        """N×4×4 true transforms from camera to world coordinates, metres."""
    @property
    def camera(self) -> Camera: ...
    @property
    def rig(self) -> Rig: ...

def simulate(
    path: Literal["straight", "square", "square-turns", "eight", "walk", "still"] = "square",
    *,
    length: float | None = None,
    speed: float = 0.5,
    turn_rate: float = ...,
    duration: float | None = None,
    texture: Literal[
        "asphalt", "carpet", "tiles", "bricks", "grass", "concrete", "bare"
    ] = "asphalt",
    camera: Camera | _Path | None = None,
    size: tuple[int, int] | None = None,
    height: float | None = None,
    rig: Rig | _Path | None = None,
    fps: float = 30.0,
    noise: float = 2.0,
    blur: float = 0.0,
    readout: float = 0.0,
    color: bool = False,
    seed: int = 1,
) -> Simulation:
    """Renders a drive over flat ground: length and height in metres, speed in metres per second,
    turn_rate in radians per second, duration, blur (exposure) and readout in seconds, noise in gray
    levels. By default 640×480 pixels from 0.9 m."""

class _Figures(TypedDict):
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float
    count: int

class _Relative(TypedDict):
    delta: str
    translation: _Figures
    rotation: _Figures

class _Drift(TypedDict):
    length_m: float
    segments: int
    translation_percent: float
    rotation_deg_per_m: float
    heading_deg_per_m: float
    heading_bias_deg_per_m: float

class Evaluation:
    """The error of a trajectory: positions in metres, rotations in radians."""

    @property
    def translation(self) -> _Figures:
        """Absolute position error, metres."""
    @property
    def rotation(self) -> _Figures:
        """Absolute rotation error, radians."""
    @property
    def errors(self) -> _Numbers:
        """N×3: time (seconds), position error (metres), rotation error (radians)."""
    @property
    def relative(self) -> list[_Relative]: ...
    @property
    def drift(self) -> list[_Drift]: ...
    @property
    def compared(self) -> int: ...
    @property
    def time_covered(self) -> float | None:
        """Part of the truth's time, 0 to 1."""
    @property
    def estimate_length(self) -> float:
        """Metres."""
    @property
    def truth_length(self) -> float:
        """Metres."""
    @property
    def scale(self) -> float | None: ...
    @property
    def final_position_error(self) -> float:
        """Metres, with the first poses aligned."""
    @property
    def final_heading_error(self) -> float:
        """Radians, with the first poses aligned."""
    @property
    def truth_from_estimate(self) -> _Numbers:
        """The 4×4 transform that aligned the estimate, without the scale."""

def evaluate(
    estimate: _Trajectory,
    truth: _Trajectory,
    *,
    align: Literal["none", "origin", "se2", "se3", "sim3"] = "se3",
    max_time_difference: float = 0.01,
    deltas: Sequence[float] = ...,
    segments: Sequence[float] = ...,
) -> Evaluation:
    """Compares a trajectory with the truth, by the definitions of evo.

    Each is a Trajectory, a Simulation, the path of a TUM or KITTI file, or a pair of N timestamps
    (seconds) and N×4×4 poses. deltas and segments are metres.
    """

class _View(TypedDict):
    name: str
    used: bool
    rms: float
    camera_from_board: _Numbers
    why_not: str | None

class Calibration:
    """A calibrated camera with its uncertainty and quality figures."""

    @property
    def camera(self) -> Camera: ...
    @property
    def model(self) -> str: ...
    @property
    def verdict(self) -> Literal["good", "usable", "do it again"]: ...
    @property
    def usable(self) -> bool: ...
    @property
    def reasons(self) -> list[str]: ...
    @property
    def rms(self) -> float:
        """Root mean square reprojection error of the views used, pixels."""
    @property
    def hold_out_rms(self) -> float:
        """The same over views held out of the fit, pixels."""
    @property
    def expected_error(self) -> float:
        """Expected error of a ray over the image, pixels."""
    @property
    def parameters(self) -> list[str]: ...
    @property
    def values(self) -> _Numbers: ...
    @property
    def covariance(self) -> _Numbers:
        """N×N, of values."""
    @property
    def views(self) -> list[_View]: ...
    def save(self, path: _Path) -> None:
        """Writes the camera file with the figures of the calibration."""

def calibrate(
    images: _Path | Iterable[_Path | _Image],
    board: str,
    *,
    model: Literal[
        "auto",
        "pinhole",
        "brown-conrady4",
        "brown-conrady5",
        "brown-conrady8",
        "kannala-brandt4",
        "double-sphere",
    ] = "auto",
    square_pixels: bool = False,
    centred: bool = False,
    bent_board: bool = False,
    max_views: int = 60,
) -> Calibration:
    """Calibrates a camera with images of a board such as "chessboard:9x6:25mm"."""
