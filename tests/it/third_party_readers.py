# SPDX-License-Identifier: MIT OR Apache-2.0
"""What other programs read of exported points: the table of docs/guide/exporting.md, as far as they are installed.

    third_party_readers.py DIR GUIDE      DIR/expected.bin, DIR/out, DIR/narrow of `tests/it/export.rs`

A reader is a function of a file that gives what it found by letter. Prints the rows that it compared.
"""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
from third_party_export import CAMERAS, POINT

AXES = "xyz"


def numpy(path):
    rows = np.loadtxt(path)
    found = {"P": rows[:, :3], "N": rows[:, 3:6]}
    if rows.shape[1] > 6:
        found |= {"I": rows[:, 6], "U": rows[:, 7:9], "K": rows[:, 9], "S": rows[:, 10]}
    return found


def columns(get, normals="nx ny nz"):
    def stack(names):
        return np.stack([np.asarray(get(name)).ravel() for name in names], 1)

    return {"P": stack(AXES), "N": stack(normals.split()), "I": get("intensity"), "U": stack("uv")} | {
        "K": get("camera"),
        "S": get("sigma"),
    }


def plyfile(path):
    import plyfile

    vertex = plyfile.PlyData.read(path)["vertex"]
    return columns(lambda name: vertex[name])


def pypcd4(path):
    import pypcd4

    points = pypcd4.PointCloud.from_path(path).pc_data
    return columns(lambda name: points[name], "normal_x normal_y normal_z")


def pye57(path):
    import pye57

    file = pye57.E57(str(path))
    number = {name: number for number, name in CAMERAS.items()}
    parts = [file.read_scan(scan, intensity=True, row_column=True) for scan in range(file.scan_count)]
    data = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    cameras = [number[file.get_header(scan)["name"].value()] for scan in range(file.scan_count)]
    return {
        "P": np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], 1),
        "I": data["intensity"],
        "U": np.stack([data["columnIndex"], data["rowIndex"]], 1),
        "K": np.repeat(cameras, [len(part["intensity"]) for part in parts]),
    }


def trimesh(path):
    import trimesh

    cloud = trimesh.load(path)
    cloud = cloud.to_geometry() if hasattr(cloud, "to_geometry") else cloud
    if "_ply_raw" in cloud.metadata:
        raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
        return columns(lambda name: raw[name])
    return {"P": cloud.vertices, "C": np.asarray(cloud.colors)[:, 0] / 255}


def open3d_legacy(path):
    import open3d

    cloud = open3d.io.read_point_cloud(str(path))
    return {"P": cloud.points, "N": cloud.normals}


def open3d_tensor(path):
    import open3d

    point = open3d.t.io.read_point_cloud(str(path)).point
    found = {letter: point[name].numpy() for letter, name in
             {"P": "positions", "N": "normals", "I": "intensity", "K": "camera", "S": "sigma"}.items() if name in point}
    return found | ({"U": np.hstack([point["u"].numpy(), point["v"].numpy()])} if "u" in point else {})


def pymeshlab(path):
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    found = {"P": np.concatenate([mesh.vertex_matrix() for mesh in meshes])}
    found["N"] = np.concatenate([mesh.vertex_normal_matrix() for mesh in meshes])
    if all(mesh.has_vertex_color() for mesh in meshes):
        found["C"] = np.concatenate([mesh.vertex_color_matrix()[:, 0] for mesh in meshes])
    if all(mesh.has_vertex_scalar() for mesh in meshes):
        found["I"] = np.concatenate([mesh.vertex_scalar_array() for mesh in meshes])
    return found


def pyvista(path):
    import pyvista

    mesh = pyvista.read(path)
    mesh = mesh.combine() if isinstance(mesh, pyvista.MultiBlock) else mesh
    names = {"N": ["Normals", "NORMAL"], "I": ["_INTENSITY"], "K": ["_CAMERA"], "S": ["_SIGMA"]}
    data = mesh.point_data
    found = {letter: data[name] for letter, known in names.items() for name in known if name in data}
    if "_U" in data:
        found["U"] = np.stack([data["_U"], data["_V"]], 1)
    colour = {"RGB": 255, "COLOR_0": 1}
    return found | {"P": mesh.points} | {"C": data[name][:, 0] / most for name, most in colour.items() if name in data}


def blender(path):
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    load = {".ply": bpy.ops.wm.ply_import, ".obj": bpy.ops.wm.obj_import, ".glb": bpy.ops.import_scene.gltf}
    load[path.suffix](filepath=str(path), **({"forward_axis": "Y", "up_axis": "Z"} if path.suffix == ".obj" else {}))
    thing = next(thing for thing in bpy.data.objects if thing.type == "MESH")
    attributes = thing.data.attributes

    def get(name, kind="value", width=1):
        values = np.empty(len(attributes[name].data) * width, np.float32)
        attributes[name].data.foreach_get(kind, values)
        return values.reshape(-1, width)

    found = {"P": get("position", "vector", 3) @ np.array(thing.matrix_world)[:3, :3].T}
    names = {"I": ["intensity", "_INTENSITY"], "K": ["camera", "_CAMERA"], "S": ["sigma", "_SIGMA"]}
    found |= {letter: get(name) for letter, known in names.items() for name in known if name in attributes}
    found |= {"U": np.hstack([get(u), get(v)]) for u, v in [("u", "v"), ("_U", "_V")] if u in attributes}
    if "normal" in attributes:
        found["N"] = get("normal", "vector", 3)
    if "Color" in attributes:
        # By glTF colours are linear.
        found["C"] = get("Color", "color" if path.suffix == ".glb" else "color_srgb", 4)[:, 0]
    return found


READERS = {
    "NumPy `loadtxt`": numpy,
    "plyfile": plyfile,
    "pypcd4": pypcd4,
    "pye57 `read_scan`": pye57,
    "trimesh `load`": trimesh,
    "Open3D `io`": open3d_legacy,
    "Open3D `t.io`": open3d_tensor,
    "pymeshlab": pymeshlab,
    "PyVista `read`": pyvista,
    "Blender import": blender,
}
FILES = {
    "`ply`": ["out/{}.ply", "out/{}.ascii.ply"],
    "`pcd`": ["out/{}.pcd"],
    "`xyz`": ["out/{}.xyz"],
    "`xyz`, 6 columns": ["narrow/{}.xyz"],
    "`e57`": ["out/{}.e57"],
    "`glb`": ["out/{}.glb"],
    "`obj`": ["out/{}.obj"],
}


def letters(read, path, expected):
    """What of the points a reader finds as it is; a dash where it finds no points."""
    try:
        found = read(path)
    except ModuleNotFoundError:
        raise
    except Exception as error:
        print(f"{path}: {read.__name__}: {type(error).__name__}: {error}", file=sys.stderr)
        return "-"

    def upright(xyz):
        return np.stack([xyz[:, 0], xyz[:, 2], -xyz[:, 1]], 1)

    kept = ""
    for letter, name in {"P": "p", "N": "n", "I": "i", "C": "i", "U": "uv", "K": "camera", "S": "sigma"}.items():
        wanted = expected[name]
        values = np.asarray(found.get(letter, []), float)
        if values.size == wanted.size:
            close = 0.006 if letter == "C" else 1e-6
            same = [wanted, upright(wanted)] if letter in "PN" else [wanted]
            kept += letter if any(np.allclose(values.reshape(way.shape), way, 0, close) for way in same) else ""
    return kept if "P" in kept else "-"


def main(directory, guide):
    warnings.simplefilter("ignore")
    expected = np.fromfile(Path(directory) / "expected.bin", POINT)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in Path(guide).read_text().splitlines()
            if line.startswith("|")]
    stated = {row[0]: row[1:] for row in rows}
    assert stated["read by"] == list(FILES), "the table's head"
    compared, differ = {}, []
    for name, read in READERS.items():
        try:
            row = []
            for paths in FILES.values():
                found = {letters(read, Path(directory) / path.format("merged/000005"), expected) for path in paths}
                row.append(" / ".join(sorted(found)))
        except ModuleNotFoundError as error:
            print(f"skipped: {name}: {error}", file=sys.stderr)
            continue
        compared[name] = row
        differ += [f"| {' | '.join([name, *row])} |"] if stated.get(name) != row else []
    assert not differ, "\n".join(["the guide should say:", *differ])
    print(json.dumps(compared))


if __name__ == "__main__":
    main(*sys.argv[1:])
