"""Calibrations of other programs, written after the documents of their formats."""

import json

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.geometry import look_at

CENTRES_M = ((4.0, 0.5, 2.0), (-3.5, 1.0, 2.4))
K = np.array([[900.0, 0.0, 650.5], [0.0, 905.0, 350.25], [0.0, 0.0, 1.0]])
SIZE_WH = (1280, 720)
RADTAN = (-0.12, 0.03, 0.0008, -0.0005)

#: File as a user writes it by hand.
RIG_TOML = """[cameras.left]
size = [1920, 1080]
K = [[1160.2, 0, 961.0], [0, 1160.9, 541.2], [0, 0, 1]]
distortion = [-0.28, 0.09, 0, 0, 0.01]
rvec = [1.2, -0.4, 0.3]
tvec = [0.1, 0.2, 5.0]
"""


def poses():
    """Rotation and translation of each camera, world to camera, metres."""
    return [look_at(centre, (0.0, 0.0, 1.0)) for centre in CENTRES_M]


def with_skew(skew):
    skewed = K.copy()
    skewed[0, 1] = skew
    return skewed


def numbers(values):
    return ", ".join(repr(float(value)) for value in np.ravel(values))


def lists(values):
    return str(np.asarray(values, float).tolist())


def matrix(name, values):
    values = np.asarray(values, float).reshape(len(np.atleast_1d(values)), -1)
    return (
        f"{name}: !!opencv-matrix\n  rows: {values.shape[0]}\n  cols: {values.shape[1]}\n  dt: d\n"
        f"  data: [{numbers(values)}]\n"
    )


def camera_tables(tables, more="", *, rodrigues=True):
    """TOML with a table for each camera, with `more` in each, in which {index} and {table} are those of the camera."""
    blocks = []
    for index, (table, (R, t)) in enumerate(zip(tables, poses(), strict=True)):
        turn = cv2.Rodrigues(R)[0].ravel() if rodrigues else R
        blocks.append(
            f"[{table}]\n{more.format(index=index, table=table)}size = [ 1280, 720,]\nmatrix = {lists(K)}\n"
            f"distortions = {lists(RADTAN)}\nrotation = {lists(turn)}\ntranslation = {lists(t)}\n"
        )
    return "\n".join(blocks)


def pose2sim_file(path):
    tables = camera_tables(("cam01", "int_cam02_img"), 'name = "{table}"\nfisheye = false\n')
    path.write_text(tables.replace("[ 1280, 720,]", "[ 1280.0, 720.0]") + METADATA)


#: The last table of anipose's files.
METADATA = "\n[metadata]\nadjusted = false\nerror = 0.26\n"
#: File as anipose 1.1 writes it: tables cam_0 ..., lengths in the board's unit.
ANIPOSE = camera_tables(("cam_0", "cam_1"), 'name = "c{index}"\n') + METADATA
#: Files as caliscope writes them: numbers as names; in older files, rotation matrices and tables of other content.
CALISCOPE = camera_tables(
    ("cameras.0", "cameras.1"), "cam_id = {index}\nrotation_count = 0\nerror = 0.541\nexposure = -8\n"
)
OLDER_CALISCOPE = (
    "CreationDate = 2023-05-06T11:12:27\ncamera_count = 0\n"
    + camera_tables(("cam_0", "cam_1"), "cam_id = {index}\nrotation_count = 0\n", rodrigues=False)
    + '[charuco]\ncolumns = 4\nunits = "inch"\n'
)


def storage_files(folder):
    """A stereo pair as OpenCV's sample writes it: two files, the second with the pose of camera 2 in camera 1."""
    (R1, t1), (R2, t2) = poses()
    R = R2 @ R1.T
    for suffix, flags in (("yml", cv2.FILE_STORAGE_FORMAT_YAML), ("xml", cv2.FILE_STORAGE_FORMAT_XML)):
        with_flags = cv2.FILE_STORAGE_WRITE | flags
        inside = cv2.FileStorage(str(folder / f"intrinsics.{suffix}"), with_flags)
        for number in (1, 2):
            inside.write(f"M{number}", K)
            inside.write(f"D{number}", np.array([RADTAN]))
        inside.release()
        outside = cv2.FileStorage(str(folder / f"extrinsics.{suffix}"), with_flags)
        for name, value in {"R": R, "T": (t2 - R @ t1)[:, None], "R1": np.eye(3), "Q": np.eye(4)}.items():
            outside.write(name, value)
        outside.release()


def json_file(folder):
    """Cameras by name, as multiview_calib writes them."""
    fields = [
        {"K": K.tolist(), "dist": [*RADTAN], "image_shape": [720, 1280], "R": R.tolist(), "t": t.tolist()}
        for R, t in poses()
    ]
    (folder / "rig.json").write_text(json.dumps(dict(zip(("6-0", "left"), fields, strict=True)), indent=1))


def sample_text():
    """A lens as OpenCV's sample program for calibration writes it."""
    size = "image_width: 1280\nimage_height: 720\n"
    return f"%YAML:1.0\n---\n{size}" + matrix("camera_matrix", K) + matrix("distortion_coefficients", RADTAN)


def ros_text(model="plumb_bob"):
    return (
        "image_width: 1280\nimage_height: 720\ncamera_name: head_camera\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: [{numbers(K)}]\ndistortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: 4\n"
        f"  data: [{numbers(RADTAN)}]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  data: [{numbers(np.eye(3))}]\n"
    )


def qualisys_file(path, change=("", "")):
    cameras = []
    for serial, (R, t) in zip((26578, 26579), poses(), strict=True):
        rows, centre_mm = np.diag([1.0, -1, -1]) @ R, -1e3 * R.T @ t
        turn = " ".join(f'r{i + 1}{j + 1}="{float(rows[i, j])!r}"' for i in range(3) for j in range(3))
        place = " ".join(f'{axis}="{float(value)!r}"' for axis, value in zip("xyz", centre_mm, strict=True))
        k1, k2, p1, p2 = RADTAN
        cameras.append(
            f'<camera active="1" serial="{serial}" model="Miqus Video" viewrotation="0">'
            f'<fov_video left="8" top="4" right="1287" bottom="723"/><transform {place} {turn}/>'
            f'<intrinsic focallength="9.3" sensorMaxU="122879" sensorMaxV="69631" focalLengthU="{64 * K[0, 0]}" '
            f'focalLengthV="{64 * K[1, 1]}" centerPointU="{64 * (K[0, 2] + 8)}" centerPointV="{64 * (K[1, 2] + 4)}" '
            f'skew="0" radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="0" '
            f'tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>'
        )
    text = f"<?xml version='1.0' encoding='ASCII'?>\n<calibration><cameras>{''.join(cameras)}</cameras></calibration>"
    path.write_text(text.replace(*change, 1))


def vicon_file(path, radial, *, video="VideoInputDevice:Blackfly", moved=""):
    cameras = []
    for device, (R, t) in zip((2121, 2122), poses(), strict=True):
        centre_mm = " ".join(repr(float(value)) for value in -1e3 * R.T @ t)
        quaternion = " ".join(repr(float(value)) for value in Rotation.from_matrix(R).as_quat())
        cameras.append(
            f'<Camera DEVICEID="{device}" PIXEL_ASPECT_RATIO="{float(K[0, 0] / K[1, 1])!r}" SKEW="0" '
            f'SENSOR_SIZE="1280 720" TYPE="{video}"><KeyFrames><KeyFrame '
            f'FOCAL_LENGTH="{K[0, 0]}" FRAME="0" ORIENTATION="{quaternion}" '
            f'POSITION="{centre_mm}" PRINCIPAL_POINT="{K[0, 2]} {K[1, 2]}" {radial}/>{moved}</KeyFrames></Camera>'
        )
    path.write_text(
        f'<?xml version="1.0" encoding="UTF-8" standalone="no" ?>\n<Cameras>{"".join(cameras)}</Cameras>'
    )


def easymocap_files(folder, *, rodrigues=True, size=True):
    inside = '%YAML:1.0\n---\nnames:\n  - "1"\n  - "07"\n  - "9"\n'
    outside = '%YAML:1.0\n---\nnames:\n  - "1"\n  - "07"\n'
    for name in ("1", "07", "9"):
        inside += matrix(f"K_{name}", K) + matrix(f"dist_{name}", [[*RADTAN, 0.0]])
        inside += f"H_{name}: 720\nW_{name}: 1280\n" if size else ""
    for name, (R, t) in zip(("1", "07"), poses(), strict=True):
        outside += matrix(f"R_{name}", cv2.Rodrigues(R)[0]) if rodrigues else matrix(f"Rot_{name}", R)
        outside += matrix(f"T_{name}", t[:, None])
    (folder / "intri.yml").write_text(inside)
    (folder / "extri.yml").write_text(outside)


def kalibr_file(path, *, distortion_model="radtan", camera_model="pinhole", chain=True):
    (R1, t1), (R2, t2) = poses()
    step = np.eye(4)
    step[:3, :3] = R2 @ R1.T
    step[:3, 3] = t2 - step[:3, :3] @ t1
    text = ""
    for index in range(2):
        text += (
            f"cam{index}:\n  cam_overlaps: [{1 - index}]\n  camera_model: {camera_model}\n"
            f"  distortion_coeffs: {lists(RADTAN)}\n  distortion_model: {distortion_model}\n"
            f"  intrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}]\n  resolution: [1280, 720]\n"
            f"  rostopic: /cam{index}/image_raw\n"
        )
    # As in the files with an inertial unit.
    text += "  T_cam_imu:\n" + "".join(f"  - {lists(row)}\n" for row in np.eye(4)[[1, 2, 0, 3]])
    text += "  timeshift_cam_imu: -8.1e-05\n"
    if chain:
        text += "  T_cn_cnm1:\n" + "".join(f"  - {lists(row)}\n" for row in step)
    path.write_text(text)


def dlt_columns(placed=None, *, upwards=False, skew=0.0):
    """11 coefficients per camera."""
    columns = []
    flip = np.array([[1.0, 0, 0], [0, -1, SIZE_WH[1]], [0, 0, 1]]) if upwards else np.eye(3)
    for R, t in placed or poses():
        P = flip @ with_skew(skew) @ np.column_stack([R, t])
        columns.append((P / P[2, 3]).ravel()[:11])
    return np.array(columns)


def dlt_file(path, columns, separator=","):
    path.write_text("\n".join(separator.join(map(repr, row)) for row in np.array(columns).T.tolist()))


def handpose_files(folder):
    for index, (R, t) in enumerate(poses()):
        rows = ["intrinsic:", *(" ".join(map(repr, row)) for row in K.tolist()), "distortion:"]
        (folder / f"c{index}.dat").write_text("\n".join([*rows, " ".join(map(repr, RADTAN)) + " 0.0"]))
        rows = ["R:", *(" ".join(map(repr, row)) for row in R.tolist()), "T:", *map(repr, t.tolist())]
        another = ["", "#below is another", "R:", "1 0 0"]
        (folder / f"rot_trans_c{index}.dat").write_text("\n".join([*rows, *another]))
