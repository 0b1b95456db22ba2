// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bootstrap registers of a GigE Vision camera: its address, its controller, and the channel of its stream.

use super::{AravisCamera, checked, link_error, message_of};
use crate::camera::error::CameraError;
use crate::camera::source_filter::{self, Route};
use crate::config::SocketMode;
use aravis::prelude::*;
use glib::prelude::{Cast, IsA};
use std::net::Ipv4Addr;

/// Register with the camera's own address.
pub(super) const OWN_ADDRESS: u64 = 0x0024;
/// Register with the control privilege: 0 when no program has it.
const PRIVILEGE: u64 = 0x0a00;
/// Register with the UDP port of the controlling program.
const HOLDER_PORT: u64 = 0x0a04;
/// Register with the address of the controlling program's host.
const HOLDER_ADDRESS: u64 = 0x0a14;
/// Register with the host's port of the first stream; 0 closes the channel.
pub(super) const HOST_PORT: u64 = 0x0d00;
/// Register with the packet size of the first stream, and flags.
pub(super) const PACKET_SIZE: u64 = 0x0d04;
/// Register with the host's address of the first stream.
pub(super) const DESTINATION: u64 = 0x0d18;
/// Register with the UDP port that the camera sends the first stream from.
const SOURCE_PORT: u64 = 0x0d1c;
/// Least packet size of a stream, bytes: the headers take up to 48.
const PACKET_LEAST: u32 = 128;

/// Address and port of the program that controls a camera; not every camera has these registers.
pub(super) fn holder(device: &impl IsA<aravis::Device>) -> Option<String> {
    let read = |register| checked::register(device, register).ok();
    let address = read(HOLDER_ADDRESS).filter(|&bits| bits != 0)?;
    Some(format!("{}:{}", Ipv4Addr::from_bits(address), read(HOLDER_PORT)? & 0xffff))
}

impl AravisCamera {
    /// The control privilege of a GigE camera: 0 when no program has it.
    pub(super) fn privilege(&self) -> Option<u32> {
        checked::register(self.device.downcast_ref::<aravis::GvDevice>()?, PRIVILEGE).ok()
    }

    /// Closes the stream channel of a GigE camera, so that frames left in the camera are dropped. Some cameras would
    /// otherwise send them at the start of the next acquisition (aravis#762). The next stream opens the channel again.
    pub(super) fn close_stream_channel(&self) {
        let Some(gv) = self.device.downcast_ref::<aravis::GvDevice>() else { return };
        if let Err(error) = gv.write_register(HOST_PORT, 0) {
            tracing::debug!("the stream channel stays open: {}", message_of(&error));
        }
    }

    /// The packet size that the camera made of the requested one; `None` for other transports. Aravis divides a frame
    /// by the payload of a packet, and would end the process where nothing is left beside the headers.
    pub(super) fn packet_bytes(&self) -> Result<Option<usize>, CameraError> {
        const DOING: &str = "reading the packet size";
        let Some(gv) = self.device.downcast_ref::<aravis::GvDevice>() else { return Ok(None) };
        match gv.packet_size().map_err(link_error(DOING))? {
            bytes if bytes >= PACKET_LEAST => Ok(Some(bytes as usize)),
            bytes => Err(CameraError::Nonsense {
                doing: DOING,
                detail: format!("packets of {bytes} bytes, headers counted in"),
            }),
        }
    }

    /// Restricts a stream's sockets to datagrams of this camera.
    pub(super) fn restrict(&self, stream: &aravis::GvStream, socket: SocketMode) -> Result<(), CameraError> {
        let address =
            checked::register(&self.device, OWN_ADDRESS).map_err(link_error("reading its address"))?;
        // Version 1.0 of the protocol has no such register, and 0 means that the port is not reported.
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
