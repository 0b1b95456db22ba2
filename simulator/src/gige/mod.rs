// SPDX-License-Identifier: MIT OR Apache-2.0
//! Simulated GigE Vision cameras: real GVCP and GVSP endpoints on loopback addresses.
//!
//! ```text
//! datagram -> [device] control thread -> [gvcp] decode -> [control] who may do what -> [registers] [map]
//!          -> answer, and orders to the stream thread
//! trigger edge or free run -> [stream] -> [sensor] accepts or ignores -> [transmit] frame -> [gvsp] packets
//!          -> [net] sendmmsg, by runs of packets where the host allows it ([segmentation])
//! ```
//!
//! A camera of another make has its features in [`make`] instead of [`map`]; what it makes of the light is in [`picture`].
//!
//! [`gvcp`], [`gvsp`], [`control`], [`registers`], [`sensor`] and [`genicam`] know no sockets and no threads.
//! `docs/design/simulated-cameras.md` lists what of the standard is implemented.

#![deny(unsafe_code)]

pub mod actions;
pub mod clock;
pub mod control;
pub mod described;
pub mod device;
mod discovery;
pub mod genicam;
pub mod gvcp;
pub mod gvsp;
pub mod habits;
mod inject;
pub mod make;
pub mod map;
mod net;
pub mod network;
mod packing;
pub mod picture;
mod presence;
pub mod registers;
mod rogue;
mod segmentation;
pub mod sensor;
pub mod settings;
mod stream;
mod test_images;
mod transmit;

pub use actions::{ActionFate, ActionFilter};
pub use clock::{CameraClock, ClockOptions};
pub use described::Described;
pub use device::{CameraOptions, SimulatedCamera};
pub use gvsp::{Form, Payload};
pub use habits::{ClockHabit, Exposures, HabitError, Habits, StampPoint};
pub use make::{Make, TableError};
pub use net::process_cpu_time;
pub use segmentation::loopback_cuts_before_receivers;
pub use test_images::{TestImages, TestStamp};

use std::net::SocketAddrV4;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

/// Manufacturer name of all simulated cameras.
pub const VENDOR: &str = "fourdbody";

/// Decides by block id and packet id whether the first transmission of a packet is lost.
pub type PacketFilter = Arc<dyn Fn(u64, u32) -> bool + Send + Sync>;

/// Counters of one camera since it was started.
#[derive(Debug, Default)]
pub struct Statistics {
    /// Frames handed to the network.
    pub frames_sent: AtomicU64,
    /// Stream packets handed to the network, without those sent again.
    pub packets_sent: AtomicU64,
    /// Triggers that came while the sensor was busy.
    pub triggers_ignored: AtomicU64,
    /// The same since the last start of an acquisition; shown in a register.
    pub(crate) triggers_ignored_now: AtomicU64,
    /// Edges on the trigger input while the camera did not wait for them.
    pub edges_unheard: AtomicU64,
    /// Packets sent again on request.
    pub packets_resent: AtomicU64,
    /// Resend requests for frames or packets that the camera does not have.
    pub resends_unavailable: AtomicU64,
    /// Writes of a client without control that were carried out: there must be none.
    pub strangers_obeyed: AtomicU64,
    /// And those that were refused.
    pub strangers_refused: AtomicU64,
    /// Frames or packets that the network refused.
    pub send_errors: AtomicU64,
    /// Longest time between the end of an exposure and the start of its transmission, ns.
    pub worst_lag_ns: AtomicU64,
}

/// Why a camera does not start.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The camera's address and port are taken, or are not this host's.
    #[error("cannot bind {address}: {source}; give each camera a free 127.x.y.z address of its own")]
    Bind {
        /// What was to be bound.
        address: SocketAddrV4,
        source: std::io::Error,
    },
    /// The image source has a size that no camera has.
    #[error("images are {width} x {height} pixels, expected 16 to 16384 columns and 1 to 16384 rows")]
    Size { width: usize, height: usize },
    /// A text does not fit into its register.
    #[error("the {field} {text:?} must have at most {limit} bytes and no NUL")]
    Text { field: &'static str, text: String, limit: usize },
    /// A socket refuses an option.
    #[error("cannot set up a camera socket: {0}")]
    Socket(std::io::Error),
    /// The system gives no thread.
    #[error("cannot start a camera thread: {0}")]
    Thread(std::io::Error),
}
