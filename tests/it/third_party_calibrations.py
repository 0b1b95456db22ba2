# SPDX-License-Identifier: MIT OR Apache-2.0
"""A stereo calibration as OpenCV, NumPy and MATLAB's users keep it: `third_party_calibrations.py DIR`.

`points.json` has points in front of the first device, mm, and the pixels at which OpenCV sees them in both devices."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

root = Path(sys.argv[1])
K1 = np.array([[1754.1, 0, 655.4], [0, 1752.9, 519.5], [0, 0, 1]])
K2 = np.array([[2496.6, 0, 640.3], [0, 2495.8, 397.0], [0, 0, 1]])
D1 = np.array([[-0.0711, -0.185, 0.000232, 0.000554, 0.4]])
D2 = np.array([[-0.0425, -0.12, -0.000689, 0.00106, 0.3]])
R, _ = cv2.Rodrigues(np.array([0.005, 0.09, 0.0098]))
T = np.array([[-108.2], [-5.16], [-15.7]])


def storage(name, values):
    file = cv2.FileStorage(str(root / name), cv2.FileStorage_WRITE)
    for key, value in values.items():
        file.write(key, value)
    file.release()


stereo = {"K1": K1, "D1": D1, "K2": K2, "D2": D2, "R": R, "T": T, "rms": 0.31}
for ending in ["yml", "xml", "json"]:
    storage(f"stereo.{ending}", stereo)
# OpenCV before 5 begins with what is no directive of YAML.
text = (root / "stereo.yml").read_text()
(root / "stereo4.yml").write_text(text.replace("%YAML 1.2", "%YAML:1.0"))
storage("intrinsics.yml", {"M1": K1, "D1": D1, "M2": K2, "D2": D2})
storage("extrinsics.yml", {"R": R, "T": T, "R1": np.eye(3), "Q": np.eye(4)})
storage("pair.yaml", {"cam_K": K1, "cam_kc": D1.T, "proj_K": K2, "proj_kc": D2.T, "R": R, "T": T})
np.savez(root / "stereo.npz", cameraMatrix1=K1, distCoeffs1=D1, cameraMatrix2=K2, distCoeffs2=D2.ravel(),
         R=np.asfortranarray(R), T=T, rvecs=np.zeros((20, 3, 1)), note="stereo")
np.savez_compressed(root / "single.npz", mtx=K1.astype(np.float32), dist=D1.astype(np.float32))
storage("rational.yml", {"K1": K1, "D1": np.hstack([D1, [[0.1, 0.2, 0.3]]])})
storage("rational_zero.yml", {"K1": K1, "D1": np.hstack([D1, [[0.0, 0.0, 0.0]]])})
storage("tilted.yml", {"K1": K1, "D1": np.hstack([D1, np.zeros((1, 7)), [[0.1, 0.0]]])})
storage("skew.yml", {"K1": K1 + np.array([[0, 2.5, 0], [0, 0, 0], [0, 0, 0]]), "D1": D1})
storage("fisheye.yml", {"camera_matrix": K1, "distortion_coefficients": D1[:, :4], "fisheye_model": 1})
storage("mirrored.yml", {**stereo, "R": -R})
storage("sized.yml", {"camera_matrix": K1, "distortion_coefficients": D1, "image_width": 640, "image_height": 480})
(root / "ros.yaml").write_text(
    "image_width: 1920\nimage_height: 1200\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    f"  data: {K1.ravel().tolist()}\ndistortion_model: equidistant\ndistortion_coefficients:\n  rows: 1\n  cols: 4\n"
    f"  data: {D1.ravel()[:4].tolist()}\n")

# Cameras around a room: the world is neither of the two.
about, at = np.array([0.3, -0.2, 0.1]), np.array([20.0, -30.0, 500.0])
turn = cv2.Rodrigues(about)[0]
both = [(K1, D1, about, at), (K2, D2, cv2.Rodrigues(R @ turn)[0].ravel(), R @ at + T.ravel())]
room = [f"matrix = {K.tolist()}\ndistortions = {D.ravel().tolist()}\nrotation = {r.tolist()}\ntranslation = {t.tolist()}\n"
        for K, D, r, t in both]
(root / "anipose.toml").write_text(f'[cam_0]\nname = "A"\n{room[0]}\n[cam_1]\nname = "B"\n{room[1]}\n[metadata]\nerror = 0.3\n')
(root / "fisheye.toml").write_text(f"[cam_0]\nfisheye = true\n{room[0]}")
(root / "caliscope.toml").write_text(
    f"[cameras.1]\nignore = true\n[cameras.2]\nport = 2\n{room[0]}\n[cameras.10]\nport = 10\n{room[1]}")


def matlab(K, D, transposed):
    """What MATLAB's toStruct has: pixels counted from one; before 2022b the matrix of rows from the right."""
    K = K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    k1, k2, p1, p2, k3 = D.ravel()
    matrix = {"IntrinsicMatrix": K.T.tolist()} if transposed else {"K": K.tolist()}
    return {**matrix, "RadialDistortion": [k1, k2, k3], "TangentialDistortion": [p1, p2], "ImageSize": [1200, 1920],
            "WorldUnits": "millimeters"}


for name, transposed in [("matlab.json", False), ("matlab_old.json", True)]:
    second = {**matlab(K2, D2, transposed), "ImageSize": []}
    (root / name).write_text(json.dumps({
        "CameraParameters1": matlab(K1, D1, transposed), "CameraParameters2": second,
        "RotationOfCamera2": R.T.tolist(), "TranslationOfCamera2": T.ravel().tolist()}))

points = np.array([[x, y, z] for x in (-150.0, 0, 140) for y in (-90.0, 30, 110) for z in (600.0, 800)])
first, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K1, D1)
second, _ = cv2.projectPoints(points, R, T, K2, D2)
(root / "points.json").write_text(json.dumps(
    {"points": points.tolist(), "first": first[:, 0].tolist(), "second": second[:, 0].tolist()}))
