// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds in whole steps, `fourdbody.QuantizedCloud`: a tenth of the bytes once a chunk is compressed, for an error that is
//! stated in the message.
//!
//! A message names its columns and the step of each; `data` has, column by column, what each point's number of steps adds
//! to that of the point before, as a 32-bit number (zigzag: 0, -1, 1, -2 are 0, 1, 2, 3), its lowest bytes first, then the
//! second ones, the third and the highest. Points lie row by row on the camera's pixel grid, so that differences are
//! small, and planes of equal bytes are what a compressor likes.
//!
//! | column | is | step |
//! |---|---|---|
//! | `x`, `y`, `z` | place, metres, world | chosen; the error is half of it on each axis, and the rounding of floats |
//! | `intensity` | 0 to 1 | 1/1020, that of the clouds themselves: no error |
//! | `normal_a`, `normal_b` | the normal on an octahedron unfolded to the square -1..1 | 1/511: at most 0.25 degrees |
//! | `u`, `v`, `camera` | as in PLY files | 1: no error |
//! | `sigma` | standard uncertainty, metres | 1e-7 |
//!
//! The octahedron: n / (|nx| + |ny| + |nz|) gives (a, b) for the upper half; for nz < 0 it is
//! ((1 - |b|) sign a, (1 - |a|) sign b), where the sign of 0 is 1.

use super::timestamp;
use crate::data::Cloud;
use crate::record::protobuf::MessageWriter;

/// The steps of places that make sense, metres: below, floats are as coarse; above, nothing is left of a surface.
pub const STEPS_M: std::ops::RangeInclusive<f64> = 1e-6..=1e-2;

const INTENSITY_STEP: f64 = 1.0 / 1020.0;
const NORMAL_STEP: f64 = 1.0 / 511.0;
const SIGMA_STEP: f64 = 1e-7;

/// Makes the message of a cloud. Numbers that are beyond 2^31 steps, or none, become 0.
pub(crate) fn encode(out: &mut Vec<u8>, time_ns: u64, cloud: &Cloud, step_m: f64) {
    let mut columns = vec![("x", step_m), ("y", step_m), ("z", step_m), ("intensity", INTENSITY_STEP)];
    columns.extend([("normal_a", NORMAL_STEP), ("normal_b", NORMAL_STEP)]);
    if cloud.pixel.len() == cloud.len() {
        columns.extend([("u", 1.0), ("v", 1.0)]);
    }
    if cloud.is_merged() {
        columns.push(("camera", 1.0));
    }
    if !cloud.sigma_m.is_empty() {
        columns.push(("sigma", SIGMA_STEP));
    }
    let mut head = MessageWriter::default()
        .message(1, timestamp(time_ns))
        .bytes(2, b"world")
        .fixed32(3, cloud.len() as u32);
    for (name, step) in &columns {
        head = head.message(4, MessageWriter::default().bytes(1, name.as_bytes()).double(2, *step));
    }
    out.clear();
    out.extend(head.bytes_header(5, (4 * columns.len() * cloud.len()) as u64).into_bytes());
    let folded: Vec<[f32; 2]> = cloud.normal.iter().map(|normal| fold(*normal)).collect();
    for (name, step) in columns {
        let steps = |x: f32| (f64::from(x) / step).round() as i32;
        match name {
            "x" => planes(out, cloud.position_m.iter().map(|p| steps(p[0]))),
            "y" => planes(out, cloud.position_m.iter().map(|p| steps(p[1]))),
            "z" => planes(out, cloud.position_m.iter().map(|p| steps(p[2]))),
            "intensity" => planes(out, cloud.intensity.iter().map(|x| steps(*x))),
            "normal_a" => planes(out, folded.iter().map(|n| steps(n[0]))),
            "normal_b" => planes(out, folded.iter().map(|n| steps(n[1]))),
            "u" => planes(out, cloud.pixel.iter().map(|p| i32::from(p[0]))),
            "v" => planes(out, cloud.pixel.iter().map(|p| i32::from(p[1]))),
            "camera" => planes(out, cloud.camera.iter().map(|c| i32::from(*c))),
            _ => planes(out, cloud.sigma_m.iter().map(|x| steps(*x))),
        }
    }
}

/// Appends a column: differences, byte by byte.
fn planes(out: &mut Vec<u8>, numbers: impl Iterator<Item = i32>) {
    let mut last = 0i32;
    let differences: Vec<u32> = numbers
        .map(|x| {
            let difference = x.wrapping_sub(std::mem::replace(&mut last, x));
            (difference << 1 ^ difference >> 31) as u32
        })
        .collect();
    for shift in [0, 8, 16, 24] {
        out.extend(differences.iter().map(|x| (x >> shift) as u8));
    }
}

/// A normal on the unfolded octahedron.
fn fold([x, y, z]: [f32; 3]) -> [f32; 2] {
    let sum = x.abs() + y.abs() + z.abs();
    let (a, b) = (x / sum, y / sum);
    if z >= 0.0 { [a, b] } else { [(1.0 - b.abs()) * 1f32.copysign(a), (1.0 - a.abs()) * 1f32.copysign(b)] }
}

#[cfg(test)]
mod tests {
    use super::{encode, fold};
    use crate::data::Cloud;
    use proptest::prelude::{prop_assert, proptest};

    #[test]
    fn a_message_has_the_bytes_that_are_described() {
        let cloud = Cloud {
            position_m: vec![[0.001, -0.001, 1.0], [0.0011, -0.001, 1.0]],
            normal: vec![[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]],
            intensity: vec![0.5, 0.5],
            ..Cloud::default()
        };
        let mut bytes = Vec::new();
        encode(&mut bytes, 0, &cloud, 1e-5);
        let data = &bytes[bytes.len() - 6 * 8..];
        // x: 100 steps, then 10 more; as zigzag 200, 20. y: -100 is 199, then 0. z: 100000 is 200000 = 0x030d40.
        assert_eq!(
            data[..24],
            [200, 20, 0, 0, 0, 0, 0, 0, 199, 0, 0, 0, 0, 0, 0, 0, 0x40, 0, 0x0d, 0, 3, 0, 0, 0]
        );
        // intensity: 510 is 1020 = 0x3fc; the lower pole is the corner (1, 1): 511 is 1022 = 0x3fe.
        assert_eq!(data[24..32], [0xfc, 0, 3, 0, 0, 0, 0, 0]);
        assert_eq!(data[32..40], [0, 0xfe, 0, 3, 0, 0, 0, 0]);
    }

    proptest! {
        #[test]
        fn the_octahedron_unfolds_to_within_a_quarter_of_a_degree(x in -1.0f32..1.0, y in -1.0f32..1.0, z in -1.0f32..1.0) {
            let length = x.hypot(y).hypot(z);
            proptest::prop_assume!(length > 0.1);
            let normal = [x / length, y / length, z / length];
            let [a, b] = fold(normal).map(|x| (x * 511.0).round() / 511.0);
            let up = 1.0 - a.abs() - b.abs();
            let (x, y) = if up >= 0.0 {
                (a, b)
            } else {
                ((1.0 - b.abs()) * 1f32.copysign(a), (1.0 - a.abs()) * 1f32.copysign(b))
            };
            let length = x.hypot(y).hypot(up);
            let cross = [y * normal[2] - up * normal[1], up * normal[0] - x * normal[2], x * normal[1] - y * normal[0]];
            let sine = cross[0].hypot(cross[1]).hypot(cross[2]) / length;
            prop_assert!(sine.asin().to_degrees() < 0.25, "{}", sine.asin().to_degrees());
            prop_assert!(x * normal[0] + y * normal[1] + up * normal[2] > 0.0);
        }
    }
}
