// SPDX-License-Identifier: MIT OR Apache-2.0
//! The filter of a stream's socket: it hears its camera and nobody else.

use super::{AravisCamera, checked, link_error};
use crate::camera::CameraError;
use crate::camera::source_filter::{self, Route};
use crate::config::SocketMode;
use std::net::Ipv4Addr;

impl AravisCamera {
    /// Sees to it that the stream hears its camera and nobody else.
    pub(super) fn restrict(&self, stream: &aravis::GvStream, socket: SocketMode) -> Result<(), CameraError> {
        const OWN_ADDRESS: u64 = 0x0024;
        const SOURCE_PORT: u64 = 0x0d1c;
        let address =
            checked::register(&self.device, OWN_ADDRESS).map_err(link_error("reading its address"))?;
        // Version 1.0 of the protocol has no such register, and 0 says that the port is not told.
        let port =
            checked::register(&self.device, SOURCE_PORT).ok().and_then(|port| u16::try_from(port).ok());
        let route = Route {
            camera: Ipv4Addr::from_bits(address),
            source_port: port.filter(|port| *port != 0),
            stream_port: stream.port(),
        };
        source_filter::restrict(route, socket == SocketMode::Auto).map_err(|e| CameraError::Link {
            doing: "setting the filter of its stream",
            detail: e.to_string(),
        })
    }
}
