# SPDX-License-Identifier: MIT OR Apache-2.0
"""Plays a sequence of clouds in Open3D, grey by intensity: `play_open3d.py sequence.mcap [TOPIC]`."""
import sys
import numpy as np
import open3d as o3d
from open_numpy import clouds

window, shown = o3d.visualization.Visualizer(), o3d.geometry.PointCloud()
window.create_window("fourdbody")
for number, (_, points) in enumerate(clouds(*sys.argv[1:])):
    shown.points = o3d.utility.Vector3dVector(np.stack([points[axis] for axis in "xyz"], 1).astype(float))
    shown.colors = o3d.utility.Vector3dVector(np.repeat(points["intensity"][:, None].astype(float), 3, 1))
    window.update_geometry(shown) if number else window.add_geometry(shown)
    window.poll_events()
    window.update_renderer()
