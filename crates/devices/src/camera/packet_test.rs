// SPDX-License-Identifier: MIT OR Apache-2.0
//! The search for the largest packet that arrives, independent of what sends them.
//!
//! Aravis' own search gives a packet 10 ms, and receives packets as large as the camera's register allows into memory
//! of the description's largest packet: a camera that sends more than it describes ends the process (0.8.26). So the
//! search is here, and receives into memory that holds any datagram.

use super::backend::PacketTest;
use super::error::CameraError;
use std::time::Duration;

/// Longest wait for the first packets: some cameras send them from a slow loop.
pub const PATIENCE: Duration = Duration::from_millis(400);
/// Least wait for further packets, which get three times as long as the first one took.
const PATIENCE_LEAST: Duration = Duration::from_millis(60);
/// Sizes to begin with when the largest does not arrive: what every network carries, and what every camera can send.
const FLOORS: [u32; 2] = [1500, 576];
/// Smallest packet that is requested, bytes.
const LEAST: u32 = 64;
/// Most attempts: halving 64 KiB takes 16, and late packets cost some more.
const STEPS: usize = 24;
/// Largest IP packet, bytes with headers.
pub const LARGEST: u32 = 65_535;
/// Bytes by which a packet may be shorter than requested, because some cameras round down (aravis#687).
pub const ROUNDED: u32 = 16;

/// The packet sizes that a camera takes by its own description, bytes.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    pub min: u32,
    pub max: u32,
    /// The step from one size to the next.
    pub step: u32,
}

/// The result of one attempt.
#[derive(Debug, Clone, Copy)]
pub struct Tried {
    /// The size that the camera made of the requested one; `None` where it refuses.
    pub size: Option<u32>,
    /// The largest packet that arrived during the attempt, of this size or late of another.
    pub arrived: Option<u32>,
    /// Time from the request to that packet.
    pub took: Duration,
}

/// Finds the largest packet that arrives, up to `requested`; `None` where none does. `attempt` makes the camera send
/// packets of one size, and waits for each as long as given.
///
/// # Errors
/// As `attempt`: the camera is lost.
pub fn largest(
    requested: u32,
    sizes: Sizes,
    mut attempt: impl FnMut(u32, Duration) -> Result<Tried, CameraError>,
) -> Result<Option<PacketTest>, CameraError> {
    let step = sizes.step.clamp(1, 1024);
    let on_step = |size: u32| size - size.saturating_sub(sizes.min) % step;
    let most = requested.min(LARGEST).min(sizes.max.max(sizes.min));
    let first = attempt(on_step(most), PATIENCE)?;
    // A camera that makes less of the requested size sends no larger packets.
    let made = first.size.unwrap_or(most).min(most);
    let camera_takes = (made < requested).then_some(made);
    let done = |arrived| Ok(Some(PacketTest { arrived, camera_takes }));
    if let Some(arrived) = first.arrived.filter(|arrived| arrived + ROUNDED >= made) {
        return done(arrived.min(made));
    }
    let (mut best, mut took) = (first.arrived, first.took);
    let is_floor = |floor: &u32| *floor >= LEAST && (sizes.min..made).contains(floor);
    for floor in FLOORS.into_iter().chain([sizes.min]).filter(is_floor) {
        if best.is_some() {
            break;
        }
        let tried = attempt(floor, PATIENCE)?;
        (best, took) = (tried.arrived, tried.took);
    }
    let Some(mut best) = best else { return Ok(None) };
    let patience = (took * 3).clamp(PATIENCE_LEAST, PATIENCE);
    let (mut beyond, mut refused) = (made, first.size.is_none());
    for _ in 0..STEPS {
        if beyond.saturating_sub(best) <= step {
            break;
        }
        let middle = on_step(best + (beyond - best) / 2).max(best + 1);
        let tried = attempt(middle, patience)?;
        match tried.arrived {
            Some(arrived) if arrived > best => best = arrived,
            _ => (beyond, refused) = (middle, tried.size.is_none()),
        }
        if best >= beyond {
            // A large packet came late: its size is not too large after all.
            beyond = made.max(best);
        }
    }
    // A size that the camera refuses is its own limit, not the network's.
    let camera_takes = if refused { Some(best) } else { camera_takes };
    Ok(Some(PacketTest { arrived: best.min(made), camera_takes }))
}

#[cfg(test)]
mod tests {
    use super::{PacketTest, Sizes, Tried, largest};
    use std::time::Duration;

    const ANY: Sizes = Sizes { min: 220, max: 16_260, step: 4 };
    const SOON: Duration = Duration::from_millis(1);

    /// A way that carries packets up to a size.
    fn carries(mtu: u32, requested: u32, sizes: Sizes) -> (Option<PacketTest>, Vec<u32>) {
        let mut tried = Vec::new();
        let found = largest(requested, sizes, |size, _| {
            tried.push(size);
            Ok(Tried { size: Some(size), arrived: (size <= mtu).then_some(size), took: SOON })
        });
        (found.expect("it answers"), tried)
    }

    #[test]
    fn the_largest_that_arrives_is_found() {
        let whole = Some(PacketTest { arrived: 9000, camera_takes: None });
        assert_eq!(carries(9000, 9000, ANY), (whole, vec![9000]), "at once");
        for mtu in [576, 1500, 1502, 4000, 8999] {
            let (found, tried) = carries(mtu, 9000, ANY);
            let found = found.expect("some arrive");
            assert!((mtu.saturating_sub(4)..=mtu).contains(&found.arrived), "{mtu}: {found:?}");
            assert_eq!(found.camera_takes, None, "it is the way that carries no more");
            assert!(tried.len() < 30, "{tried:?}");
        }
        assert_eq!(carries(100, 9000, ANY).0, None, "none at all");
    }

    #[test]
    fn a_camera_is_sent_no_larger_request_than_it_takes() {
        let small = Sizes { min: 220, max: 1444, step: 4 };
        let (found, tried) = carries(65_535, 9000, small);
        assert_eq!(found, Some(PacketTest { arrived: 1444, camera_takes: Some(1444) }));
        assert!(tried.iter().all(|size| *size <= 1444), "{tried:?}");
        // A description without sense: the least is above the largest, and steps have no length.
        for sizes in [
            Sizes { min: 9000, max: 0, step: 0 },
            Sizes { min: 0, max: u32::MAX, step: u32::MAX },
            Sizes { min: u32::MAX, max: u32::MAX, step: 7 },
        ] {
            for mtu in [0, 1500, 65_535] {
                let (_, tried) = carries(mtu, u32::MAX, sizes);
                assert!(tried.iter().all(|size| *size <= 65_535) && tried.len() < 30, "{sizes:?}: {tried:?}");
            }
        }
    }

    #[test]
    fn one_that_makes_less_of_it_or_refuses_says_what_it_takes() {
        let clamps = |size: u32, _| {
            let size = size.min(8000);
            Ok(Tried { size: Some(size), arrived: Some(size), took: SOON })
        };
        let expected = Some(PacketTest { arrived: 8000, camera_takes: Some(8000) });
        assert_eq!(largest(9000, ANY, clamps).expect("it answers"), expected);
        let refuses = |size: u32, _| {
            let size = Some(size).filter(|size| *size <= 8000);
            Ok(Tried { size, arrived: size, took: SOON })
        };
        let found = largest(9000, ANY, refuses).expect("it answers").expect("some arrive");
        assert!((7996..=8000).contains(&found.arrived), "{found:?}");
        assert_eq!(found.camera_takes, Some(found.arrived), "the network was not tested");
    }

    #[test]
    fn packets_that_come_late_count_and_set_how_long_is_waited() {
        // Each arrives when the next is requested already.
        let mut on_its_way = None;
        let found = largest(9000, ANY, |size, _| {
            let arrived = on_its_way.replace(size);
            Ok(Tried { size: Some(size), arrived, took: Duration::from_millis(100) })
        });
        assert_eq!(found.expect("it answers").map(|found| found.arrived), Some(9000));
        let mut patience = Vec::new();
        let slow = largest(9000, ANY, |size, waits| {
            patience.push(waits);
            let arrived = (size <= 1500).then_some(size);
            Ok(Tried { size: Some(size), arrived, took: Duration::from_millis(100) })
        });
        assert_eq!(slow.expect("it answers").map(|found| found.arrived), Some(1500));
        assert_eq!(patience.last(), Some(&Duration::from_millis(300)));
    }
}
