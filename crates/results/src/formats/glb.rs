// SPDX-License-Identifier: MIT OR Apache-2.0
//! glTF 2.0 in its binary form (GLB): points, or a triangle mesh, in one interleaved buffer.
//!
//! The numbers are those of the world frame, whose z is up; glTF's y is up, so that the node that holds the shape
//! turns it. Beside `POSITION` and `NORMAL` points have `COLOR_0` (the intensity as a grey, for viewers),
//! `_INTENSITY`, and where they are known `_U`, `_V`, `_CAMERA` and `_SIGMA` (m). All of these are single floats: VTK
//! reads no others, and Blender mixes up attributes that differ in type.

use super::shape::Shape;
use serde_json::{Value, json};
use std::io::{self, BufWriter, Write};

/// Half the square root of two: the quaternion that turns z up into y up.
const HALF_ROOT: f64 = std::f64::consts::FRAC_1_SQRT_2;

// Component types, buffer targets and primitive modes, as glTF 2.0 numbers them.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const POINTS: u32 = 0;
const TRIANGLES: u32 = 4;

/// Bytes of a vertex: position, normal, intensity, colour, pixel, camera, uncertainty.
const STRIDE: usize = 12 + 12 + 4 + 4 + 8 + 4 + 4;

/// Writes GLB. An error where the buffer would be longer than the format can state (4 GiB).
pub(crate) fn write(out: impl Write, shape: &Shape<'_>) -> io::Result<()> {
    let vertices = shape.cloud.len() * STRIDE;
    let length = vertices + 12 * shape.triangles.len();
    let mut text = serde_json::to_vec(&document(shape, length))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let empty = shape.cloud.is_empty();
    let whole = 12 + 8 + text.len() + if empty { 0 } else { 8 + length };
    let size = |bytes: usize| {
        u32::try_from(bytes).map_err(|_| io::Error::other("more than 4 GiB, which GLB cannot hold"))
    };
    let mut out = BufWriter::with_capacity(1 << 18, out);
    let mut words = |words: &[u32]| words.iter().try_for_each(|word| out.write_all(&word.to_le_bytes()));
    words(&[u32::from_le_bytes(*b"glTF"), 2, size(whole)?])?;
    words(&[size(text.len())?, u32::from_le_bytes(*b"JSON")])?;
    out.write_all(&text)?;
    if !empty {
        let mut words = |words: &[u32]| words.iter().try_for_each(|word| out.write_all(&word.to_le_bytes()));
        words(&[size(length)?, u32::from_le_bytes(*b"BIN\0")])?;
        let mut bytes = Vec::with_capacity(STRIDE);
        for i in 0..shape.cloud.len() {
            bytes.clear();
            pack(shape, i, &mut bytes);
            out.write_all(&bytes)?;
        }
        for corner in shape.triangles.iter().flatten() {
            out.write_all(&corner.to_le_bytes())?;
        }
    }
    out.flush()
}

fn pack(shape: &Shape<'_>, i: usize, out: &mut Vec<u8>) {
    let cloud = shape.cloud;
    let floats = cloud.position_m[i].iter().chain(&cloud.normal[i]).chain([&cloud.intensity[i]]);
    floats.for_each(|x| out.extend_from_slice(&x.to_le_bytes()));
    let grey = (cloud.intensity[i].clamp(0.0, 1.0) * 255.0).round() as u8;
    out.extend_from_slice(&[grey, grey, grey, 255]);
    let [u, v] = cloud.pixel.get(i).copied().unwrap_or_default().map(f32::from);
    let camera = f32::from(cloud.camera.get(i).copied().unwrap_or(crate::data::NO_CAMERA));
    let sigma = cloud.sigma_m.get(i).copied().unwrap_or_default();
    [u, v, camera, sigma].iter().for_each(|x| out.extend_from_slice(&x.to_le_bytes()));
}

fn document(shape: &Shape<'_>, length: usize) -> Value {
    let cameras: Value =
        shape.cameras.iter().map(|(number, name)| (number.to_string(), json!(name))).collect();
    let asset = json!({
        "version": "2.0",
        "generator": concat!("fourdbody ", env!("CARGO_PKG_VERSION")),
        "extras": {"comments": shape.comments, "cameras": cameras, "frame": "world: metres, z up; the node turns it to y up"},
    });
    let node = json!({"name": "world", "rotation": [-HALF_ROOT, 0.0, 0.0, HALF_ROOT]});
    let mut document = json!({"asset": asset, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node]});
    if shape.cloud.is_empty() {
        // A buffer, a view or an accessor may not be empty: there is only the node.
        return document;
    }
    let vertices = shape.cloud.len() * STRIDE;
    let mut accessors = accessors(shape);
    let mut views =
        vec![json!({"buffer": 0, "byteLength": vertices, "byteStride": STRIDE, "target": ARRAY_BUFFER})];
    let mut attributes = json!({"POSITION": 0, "NORMAL": 1, "_INTENSITY": 2, "COLOR_0": 3});
    let mut optional = |name: &str, here: bool, offset: usize| {
        if here {
            attributes[name] = json!(accessors.len());
            accessors.push(accessor(shape, offset, FLOAT, "SCALAR"));
        }
    };
    let pixels = shape.cloud.pixel.len() == shape.cloud.len();
    optional("_U", pixels, 32);
    optional("_V", pixels, 36);
    optional("_CAMERA", shape.cloud.is_merged(), 40);
    optional("_SIGMA", !shape.cloud.sigma_m.is_empty(), 44);
    let mut primitive = json!({"attributes": attributes, "mode": POINTS, "material": 0});
    if !shape.triangles.is_empty() {
        views.push(json!({"buffer": 0, "byteOffset": vertices, "byteLength": length - vertices, "target": ELEMENT_ARRAY_BUFFER}));
        primitive["mode"] = json!(TRIANGLES);
        primitive["indices"] = json!(accessors.len());
        accessors.push(json!({"bufferView": 1, "componentType": UNSIGNED_INT, "count": 3 * shape.triangles.len(), "type": "SCALAR"}));
    }
    document["nodes"][0]["mesh"] = json!(0);
    document["buffers"] = json!([{"byteLength": length}]);
    document["bufferViews"] = json!(views);
    document["accessors"] = json!(accessors);
    document["materials"] = json!([{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": true}]);
    document["meshes"] = json!([{"primitives": [primitive]}]);
    document
}

/// Those that every point has.
fn accessors(shape: &Shape<'_>) -> Vec<Value> {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for point in &shape.cloud.position_m {
        for axis in 0..3 {
            low[axis] = low[axis].min(point[axis]);
            high[axis] = high[axis].max(point[axis]);
        }
    }
    let mut position = accessor(shape, 0, FLOAT, "VEC3");
    (position["min"], position["max"]) = (json!(low), json!(high));
    let mut colour = accessor(shape, 28, UNSIGNED_BYTE, "VEC4");
    colour["normalized"] = json!(true);
    vec![position, accessor(shape, 12, FLOAT, "VEC3"), accessor(shape, 24, FLOAT, "SCALAR"), colour]
}

fn accessor(shape: &Shape<'_>, offset: usize, component: u32, kind: &str) -> Value {
    let count = shape.cloud.len();
    json!({"bufferView": 0, "byteOffset": offset, "componentType": component, "count": count, "type": kind})
}
