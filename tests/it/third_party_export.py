# SPDX-License-Identifier: MIT OR Apache-2.0
"""Opens exported files with readers that are not ours, and compares them with what they were made of.

    third_party_export.py clouds DIR      DIR/expected.bin, DIR/out
    third_party_export.py images DIR 0|1  the same; whether there are videos
    third_party_export.py frames DIR      DIR/out, of `recording::record`
    third_party_export.py sequence FILE CAMERA TRIGGER_TIME_NS
    third_party_export.py ball CLOSED_MESH GRID_MESH X Y Z RADIUS

Prints what it found as JSON.
"""

import csv
import json
import os
import sys
from pathlib import Path

import numpy as np

POINT = np.dtype([("p", "<f4", 3), ("i", "<f4"), ("n", "<f4", 3), ("uv", "<u2", 2), ("camera", "u1"), ("sigma", "<f4")])
CAMERAS = {0: "h0_up", 3: "h1_low"}


def same(found, expected, what):
    found = np.asarray(found)
    assert found.shape == expected.shape, f"{what}: {found.shape}, expected {expected.shape}"
    # Exactly: every format here holds 32-bit floats, or their shortest text.
    assert np.array_equal(found.astype(expected.dtype), expected), f"{what} differs"


def table(get, expected, what):
    same(np.stack([get(name) for name in "xyz"], 1), expected["p"], f"{what} places")
    same(get("intensity"), expected["i"], f"{what} intensity")
    same(np.stack([get("u"), get("v")], 1), expected["uv"], f"{what} pixels")
    same(get("camera"), expected["camera"], f"{what} camera")
    same(get("sigma"), expected["sigma"], f"{what} uncertainty")


def clouds(directory):
    import plyfile
    import pye57
    import pygltflib
    import pypcd4
    import trimesh

    directory = Path(directory)
    expected = np.fromfile(directory / "expected.bin", POINT)
    merged = directory / "out/merged/000005"
    for suffix in [".ply", ".ascii.ply"]:
        ply = plyfile.PlyData.read(f"{merged}{suffix}")
        vertex = ply["vertex"]
        table(lambda name: vertex[name], expected, suffix)
        same(np.stack([vertex[f"n{axis}"] for axis in "xyz"], 1), expected["n"], suffix)
        assert "trigger 5" in ply.comments and "cameras 0=h0_up 3=h1_low" in ply.comments, ply.comments
        same(trimesh.load(f"{merged}{suffix}").vertices, expected["p"], f"{suffix} in trimesh")

    pcd = pypcd4.PointCloud.from_path(f"{merged}.pcd").pc_data
    table(lambda name: pcd[name], expected, "pcd")
    same(np.stack([pcd[f"normal_{axis}"] for axis in "xyz"], 1), expected["n"], "pcd normals")

    xyz = np.loadtxt(f"{merged}.xyz", dtype=np.float32)
    names = "x y z nx ny nz intensity u v camera sigma".split()
    table(lambda name: xyz[:, names.index(name)], expected, "xyz")
    same(xyz[:, 3:6], expected["n"], "xyz normals")
    # Readers that do not know `#` get the same rows, and those that know six columns get six.
    rows = Path(f"{merged}.xyz").read_text().splitlines()
    plain = (directory / "plain/merged/000005.xyz").read_text().splitlines()
    assert plain == [row for row in rows if not row.startswith("#")], "xyz without comments"
    narrow = (directory / "narrow/merged/000005.xyz").read_text().splitlines()
    assert narrow == [" ".join(row.split()[:6]) for row in plain], "xyz of six columns"
    same(trimesh.load(directory / "plain/merged/000005.xyz").vertices, expected["p"], "xyz in trimesh")

    scans = pye57.E57(f"{merged}.e57")
    assert scans.scan_count == len(CAMERAS), scans.scan_count
    for scan, (number, name) in enumerate(CAMERAS.items()):
        part = expected[expected["camera"] == number]
        assert scans.get_header(scan)["name"].value() == name
        same(np.stack(list(scans.read_scan(scan).values()), 1), part["p"], "e57 as pye57 reads it by default")
        data = scans.read_scan(scan, intensity=True, colors=False, row_column=True)
        same(np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], 1), part["p"], "e57 places")
        same(data["intensity"], part["i"], "e57 intensity")
        same(np.stack([data["columnIndex"], data["rowIndex"]], 1), part["uv"], "e57 pixels")
        same(np.stack([e57_field(scans, scan, f"nor:normal{axis}") for axis in "XYZ"], 1), part["n"], "e57 normals")

    gltf = pygltflib.GLTF2().load(f"{merged}.glb")
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS
    attributes = vars(primitive.attributes)
    same(attribute(gltf, attributes["POSITION"]), expected["p"], "glb places")
    same(attribute(gltf, attributes["NORMAL"]), expected["n"], "glb normals")
    same(attribute(gltf, attributes["_INTENSITY"])[:, 0], expected["i"], "glb intensity")
    same(np.hstack([attribute(gltf, attributes[f"_{axis}"]) for axis in "UV"]), expected["uv"], "glb pixels")
    # Blender mixes up attributes of its own that differ in type: it takes them in the order of a hash.
    own = [gltf.accessors[index] for name, index in attributes.items() if name.startswith("_") and index]
    assert len(own) == 5 and {(a.type, a.componentType) for a in own} == {("SCALAR", pygltflib.FLOAT)}
    same(attribute(gltf, attributes["_CAMERA"])[:, 0], expected["camera"], "glb camera")
    same(attribute(gltf, attributes["_SIGMA"])[:, 0], expected["sigma"], "glb uncertainty")
    # A viewer sees z up as y up.
    turned = trimesh.load(f"{merged}.glb").to_geometry().vertices
    x, y, z = expected["p"].T
    assert np.allclose(turned, np.stack([x, z, -y], 1), atol=1e-6), "glb is not turned to y up"

    lines = Path(f"{merged}.obj").read_text().splitlines()
    rows = np.array([line.split()[1:] for line in lines if line.startswith("v ")], np.float32)
    same(rows[:, :3], expected["p"], "obj places")
    same(rows[:, 3], expected["i"], "obj intensity")
    normals = np.array([line.split()[1:] for line in lines if line.startswith("vn ")], np.float32)
    same(normals, expected["n"], "obj normals")
    same(trimesh.load(f"{merged}.obj").vertices, expected["p"], "obj in trimesh")
    single = plyfile.PlyData.read(directory / "out/clouds/h1_low_000005.ply")["vertex"]
    assert "camera" not in single and len(single.data) == (expected["camera"] == 3).sum()

    found = {"points": len(expected), "grid": {}, "watertight": {}}
    for suffix in ["ply", "ascii.ply", "obj", "glb"]:
        mesh = solid(directory / f"out/meshes/000005.{suffix}")
        found["grid"][suffix] = [len(mesh.vertices), len(mesh.faces), mesh.area]
        closed = solid(directory / f"out/watertight/000005.{suffix}")
        assert closed.is_watertight and closed.is_winding_consistent, suffix
        found["watertight"][suffix] = [len(closed.vertices), len(closed.faces), closed.volume]
    try:
        import open3d
    except ImportError:
        found["open3d"] = None
    else:
        for suffix in ["ply", "ascii.ply", "pcd", "xyz"]:
            cloud = open3d.io.read_point_cloud(f"{merged}.{suffix}")
            same(np.asarray(cloud.points).astype(np.float32), expected["p"], f"{suffix} in Open3D")
            if suffix != "xyz":
                same(np.asarray(cloud.normals).astype(np.float32), expected["n"], f"{suffix} normals in Open3D")
        mesh = open3d.io.read_triangle_mesh(str(directory / "out/watertight/000005.obj"))
        # No edge with other than two triangles, no corner where two surfaces meet. (Slivers of 0.01 mm may touch others by the
        # rounding of floats, which Open3D's own `is_watertight` minds.)
        assert mesh.is_edge_manifold(False) and mesh.is_vertex_manifold()
        found["open3d"] = open3d.__version__
    return found


def e57_field(file, scan, name):
    from pye57 import libe57

    header = file.get_header(scan)
    values = np.empty(header.point_count, np.float32)
    buffers = libe57.VectorSourceDestBuffer()
    buffers.append(libe57.SourceDestBuffer(file.image_file, name, values, header.point_count, True, True))
    header.points.reader(buffers).read()
    return values


def attribute(gltf, index):
    accessor = gltf.accessors[index]
    view = gltf.bufferViews[accessor.bufferView]
    kind = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor.componentType]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor.type]
    offset = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    rows = np.ndarray((accessor.count, width), kind, gltf.binary_blob(), offset, (view.byteStride, np.dtype(kind).itemsize))
    if accessor.max:
        assert accessor.max == rows.max(0).tolist() and accessor.min == rows.min(0).tolist(), "bounds"
    return rows


def solid(path):
    import trimesh

    # Corners as they are: merging them would hide open edges.
    mesh = trimesh.load(path, process=False, maintain_order=True)
    return mesh.to_geometry() if hasattr(mesh, "to_geometry") else mesh


def images(directory, videos):
    from PIL import Image

    directory = Path(directory)
    expected = np.fromfile(directory / "expected.bin", POINT)
    count = 0
    for number, camera in CAMERAS.items():
        part = expected[expected["camera"] == number]
        picture = np.zeros((1200, 1920), np.uint8)
        picture[part["uv"][:, 1], part["uv"][:, 0]] = np.floor((np.float32(255) * part["i"]).astype(float) + 0.5)
        for trigger in (3, 5):
            with Image.open(directory / f"out/intensity/{camera}/{trigger:06d}.png") as image:
                assert image.mode == "L"
                same(image, picture, f"{camera} {trigger}")
                count += 1
    if int(videos):
        import cv2

        video = cv2.VideoCapture(str(directory / "out/intensity/h1_low.mp4"))
        assert video.get(cv2.CAP_PROP_FPS) == 60 and video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
        for shown in (picture, 0 * picture, picture):
            is_there, image = video.read()
            assert is_there and image.shape == (1200, 1920, 3), "a frame of the video"
            # Coded with loss.
            assert abs(image[..., 0].astype(float) - shown).mean() < 1, "another picture"
        assert not video.read()[0], "one frame too many"
    return {"pictures": count}


def frames(directory):
    import tifffile
    from PIL import Image

    directory = Path(directory)
    count = 0
    for number, camera in enumerate(["h0_up", "h0_low"]):
        for trigger in range(6):
            i = np.arange(40 * 30)
            expected = ((i * 7 + trigger * 13 + number * 101) & 255).astype(np.uint8).reshape(30, 40)
            path = directory / f"out/{camera}/{trigger:06d}"
            if (number, trigger) == (1, 4):
                assert not path.with_suffix(".png").exists() and not path.with_suffix(".tiff").exists()
                continue
            with Image.open(f"{path}.png") as image:
                assert image.mode == "L"
                same(image, expected, f"{path}.png")
            same(tifffile.imread(f"{path}.tiff"), expected, f"{path}.tiff")
            count += 1
    with open(directory / "out/timing.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12
    first = min(int(row["hsu_time_ns"]) for row in rows)
    for row in rows:
        trigger = int(row["trigger"])
        assert int(row["hsu_time_ns"]) == first + trigger * 8_333_333
        if row["camera"] == "h0_low" and trigger == 4:
            assert (row["outcome"], row["block_id"], row["camera_time_ns"]) == ("missing_packets", "", "")
        else:
            assert (row["outcome"], int(row["block_id"]) - int(rows[0]["block_id"])) == ("frame", trigger)
            assert int(row["camera_time_ns"]) - int(rows[0]["camera_time_ns"]) == trigger * 8_333_333
            assert int(row["host_time_ns"]) - int(rows[0]["host_time_ns"]) == trigger * 8_333_333
    return {"frames": count}


class Counting:
    """A file that counts what is read of it."""

    def __init__(self, path):
        self.file, self.bytes = open(path, "rb"), 0

    def read(self, size=-1):
        data = self.file.read(size)
        self.bytes += len(data)
        return data

    def __getattr__(self, name):
        return getattr(self.file, name)


def sequence(path, camera, time_ns):
    from mcap.reader import SeekingReader

    time_ns = int(time_ns)

    def read(**wanted):
        file = Counting(path)
        messages = [(c.topic, m.log_time, len(m.data)) for _, c, m in SeekingReader(file).iter_messages(**wanted)]
        return {"messages": messages, "bytes": file.bytes}

    base = SeekingReader(open(path, "rb")).get_summary()
    topics = sorted(channel.topic for channel in base.channels.values())
    prefix = topics[0].split("/")[1]
    return {
        "size": os.path.getsize(path),
        "topics": topics,
        "chunks": len(base.chunk_indexes),
        "compression": sorted({chunk.compression for chunk in base.chunk_indexes}),
        "one": read(topics=[f"/{prefix}/{camera}"], start_time=time_ns, end_time=time_ns + 1),
        "camera": read(topics=[f"/{prefix}/{camera}"]),
    }


def ball(closed, grid, *numbers):
    closed, grid = solid(closed), solid(grid)
    *centre, radius = map(float, numbers)
    whole = 4 / 3 * np.pi * radius**3
    # Pyramids from the centre to the triangles up to 37 degrees of latitude, which the cameras see.
    corners = closed.vertices[closed.faces] - centre
    middle = corners.mean(1)
    seen = abs(middle[:, 2]) < 0.6 * np.linalg.norm(middle, axis=1)
    volumes = np.linalg.det(corners) / 6
    off = abs(np.linalg.norm(closed.vertices - centre, axis=1) - radius)
    return {
        "watertight": bool(closed.is_watertight),
        "volume_error": volumes.sum() / whole - 1,
        "seen_volume_error": volumes[seen].sum() / (0.6 * whole) - 1,
        "median_m": np.median(off),
        "seen_worst_m": off[closed.faces[seen]].max(),
        "worst_m": off.max(),
        "grid_area": grid.area / (4 * np.pi * radius**2),
        "grid_worst_m": abs(np.linalg.norm(grid.triangles_center - centre, axis=1) - radius).max(),
    }


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]](*sys.argv[2:])))
