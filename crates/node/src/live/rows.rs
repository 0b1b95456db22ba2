// SPDX-License-Identifier: MIT OR Apache-2.0
//! What nodes hand each other for the live body: every fourth row of the frames of one trigger, as bytes.
//!
//! ```text
//! "4DBR", version u8 = 1, cameras u8, trigger u64
//! each camera: length of its name u8, its name, host time of the frame's arrival ns u64, columns u16, rows u16
//! then the pixels of all cameras, row by row
//! ```
//! Little-endian. Whatever the bytes are, reading them never panics and allocates no more than they are.

use crate::acquire::preview::Sample;
use crate::base::ids::{CameraId, check_name};
use std::collections::BTreeMap;

const MAGIC: &[u8; 4] = b"4DBR";
const VERSION: u8 = 1;

/// The rows of one trigger, by camera.
pub type Rows = BTreeMap<CameraId, Sample>;

/// As bytes. Cameras beyond 255 are left out, as is what is no frame of a camera.
pub fn encode<'a>(trigger: u64, rows: impl Iterator<Item = (&'a CameraId, &'a Sample)>) -> Vec<u8> {
    let fits = |(id, sample): &(&CameraId, &Sample)| {
        id.as_str().len() <= 255
            && (1..=usize::from(u16::MAX)).contains(&sample.width)
            && sample.pixels.len().is_multiple_of(sample.width)
            && sample.pixels.len() / sample.width <= usize::from(u16::MAX)
    };
    let kept: Vec<_> = rows.filter(fits).take(255).collect();
    let pixels: usize = kept.iter().map(|(_, sample)| sample.pixels.len()).sum();
    let mut bytes = Vec::with_capacity(pixels + 64 * kept.len() + 16);
    bytes.extend(MAGIC);
    bytes.extend([VERSION, kept.len() as u8]);
    bytes.extend(trigger.to_le_bytes());
    for (id, sample) in &kept {
        bytes.push(id.as_str().len() as u8);
        bytes.extend(id.as_str().as_bytes());
        bytes.extend(sample.host_time_ns.to_le_bytes());
        bytes.extend((sample.width as u16).to_le_bytes());
        bytes.extend(((sample.pixels.len() / sample.width) as u16).to_le_bytes());
    }
    kept.iter().for_each(|(_, sample)| bytes.extend(&sample.pixels));
    bytes
}

/// What a node answers of a trigger: rows of its own cameras, and of no other.
///
/// # Errors
/// What is wrong with the bytes, or whose rows they are.
pub fn of_node(bytes: &[u8], trigger: u64, cameras: &[CameraId]) -> Result<Rows, String> {
    let (found, rows) = decode(bytes)?;
    if found != trigger {
        return Err(format!("expected rows of trigger {trigger}, found those of {found}"));
    }
    match rows.keys().find(|id| !cameras.contains(id)) {
        Some(foreign) => Err(format!("expected rows of that node's cameras, found those of {foreign}")),
        None => Ok(rows),
    }
}

/// From bytes: the trigger and its rows, or what is wrong.
fn decode(bytes: &[u8]) -> Result<(u64, Rows), String> {
    let mut rest = bytes;
    if take::<4>(&mut rest)? != *MAGIC {
        return Err("expected rows of a trigger, found something else".to_owned());
    }
    let [version, cameras] = take::<2>(&mut rest)?;
    if version != VERSION {
        return Err(format!(
            "expected rows of version {VERSION}, found {version}; run the same program on all nodes"
        ));
    }
    let trigger = u64::from_le_bytes(take(&mut rest)?);
    let mut heads = Vec::new();
    for _ in 0..cameras {
        let [length] = take::<1>(&mut rest)?;
        let name = cut(&mut rest, usize::from(length))?;
        let name = std::str::from_utf8(name).map_err(|e| format!("the name of a camera: {e}"))?;
        check_name(name).map_err(|e| format!("the name of a camera: {e}"))?;
        let host_time_ns = u64::from_le_bytes(take(&mut rest)?);
        let width = usize::from(u16::from_le_bytes(take(&mut rest)?));
        let height = usize::from(u16::from_le_bytes(take(&mut rest)?));
        heads.push((CameraId::from(name), host_time_ns, width, height));
    }
    let mut rows = Rows::new();
    for (id, host_time_ns, width, height) in heads {
        let pixels = cut(&mut rest, width * height)?.to_vec();
        if rows
            .insert(id.clone(), Sample { trigger, host_time_ns, width, pixels, ..Sample::default() })
            .is_some()
        {
            return Err(format!("camera {id} is there twice"));
        }
    }
    if rest.is_empty() { Ok((trigger, rows)) } else { Err(format!("{} bytes too many", rest.len())) }
}

fn cut<'a>(rest: &mut &'a [u8], length: usize) -> Result<&'a [u8], String> {
    let (found, after) = rest
        .split_at_checked(length)
        .ok_or_else(|| format!("expected {length} bytes more, found {}", rest.len()))?;
    *rest = after;
    Ok(found)
}

fn take<const N: usize>(rest: &mut &[u8]) -> Result<[u8; N], String> {
    let found = cut(rest, N)?;
    found.try_into().map_err(|_| "too short".to_owned())
}

#[cfg(test)]
mod tests {
    use super::{Rows, decode, encode, of_node};
    use crate::acquire::preview::Sample;
    use crate::base::ids::CameraId;
    use proptest::prelude::{any, prop, prop_assert_eq, proptest};

    #[test]
    fn a_node_has_rows_of_its_own_cameras_and_of_no_other() {
        let sample = Sample { trigger: 8, width: 1, pixels: vec![7], ..Sample::default() };
        let bytes = |ids: &[&str]| {
            let rows: Rows = ids.iter().map(|id| (CameraId::from(*id), sample.clone())).collect();
            encode(8, rows.iter())
        };
        let theirs = [CameraId::from("h2_up"), CameraId::from("h2_low")];
        assert_eq!(of_node(&bytes(&["h2_up"]), 8, &theirs).map(|rows| rows.len()), Ok(1));
        assert!(
            of_node(&bytes(&["h2_up"]), 16, &theirs)
                .expect_err("another trigger")
                .contains("found those of 8")
        );
        let forged = of_node(&bytes(&["h0_up", "h2_up"]), 8, &theirs).expect_err("a camera of ours");
        assert!(forged.contains("found those of h0_up"), "{forged}");
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(
            trigger in any::<u64>(),
            cameras in prop::collection::vec((any::<u64>(), 1usize..20, 0usize..9, any::<u8>()), 0..5),
        ) {
            let sample = |&(host_time_ns, width, rows, grey): &(u64, usize, usize, u8)| Sample {
                trigger, host_time_ns, width, pixels: vec![grey; width * rows], ..Sample::default()
            };
            let named = cameras.iter().enumerate().map(|(i, camera)| (CameraId(format!("h{i}_up")), sample(camera)));
            let rows: Rows = named.collect();
            let bytes = encode(trigger, rows.iter());
            prop_assert_eq!(decode(&bytes), Ok((trigger, rows)));
            for cut in 0..bytes.len() {
                prop_assert_eq!(decode(&bytes[..cut]).is_err(), true);
            }
        }

        #[test]
        fn any_bytes_are_read_or_refused(mut bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = decode(&bytes);
            bytes.splice(0..0, *b"4DBR\x01");
            let _ = decode(&bytes);
        }
    }
}
