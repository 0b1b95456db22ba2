// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras that were found on a network interface or a bus, and the names by which each is known.

use crate::camera::CameraListing;
use crate::network::{Answer, Mac};
use std::fmt;

/// A camera that answered a broadcast, or was listed on a bus.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Found {
    /// What a node file calls its address: an IP address, or an Aravis id.
    pub place: String,
    /// Its MAC; none where it has no network.
    pub mac: Option<Mac>,
    pub vendor: String,
    pub model: String,
    pub serial: String,
    /// The user-defined name that is stored in it; empty where there is none.
    pub user_name: String,
    /// The network interface on which it answered.
    pub interface: Option<String>,
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {} at {}", self.vendor, self.model, self.serial, self.place)?;
        self.mac.map_or(Ok(()), |mac| write!(f, " ({mac})"))
    }
}

impl Found {
    /// One that answered a broadcast.
    pub fn of_network(answer: &Answer) -> Self {
        Self {
            place: answer.address.to_string(),
            mac: Some(answer.mac),
            vendor: answer.vendor.clone(),
            model: answer.model.clone(),
            serial: answer.serial.clone(),
            user_name: answer.user_name.clone(),
            interface: Some(answer.interface.clone()),
        }
    }

    /// One on a bus; `None` for one of a network.
    pub fn of_bus(listing: &CameraListing) -> Option<Self> {
        (listing.protocol == "USB3Vision").then(|| Self {
            place: listing.id.clone(),
            mac: None,
            vendor: listing.vendor.clone(),
            model: listing.model.clone(),
            serial: listing.serial.clone(),
            user_name: String::new(),
            interface: None,
        })
    }

    /// Whether it is known by this: MAC, address, serial number or a name of its own.
    pub fn is_known_as(&self, who: &str) -> bool {
        self.mac.is_some_and(|mac| who.eq_ignore_ascii_case(&mac.to_string()))
            || who == self.place
            || who == self.serial
            || !self.user_name.is_empty() && who == self.user_name
    }
}
