// SPDX-License-Identifier: MIT OR Apache-2.0
//! The API's routes, a file per resource; each has `routes()` with handlers and their description.

pub(super) mod captures;
pub(super) mod description;
pub(super) mod devices;
pub(super) mod exposure;
pub(super) mod health;
pub(super) mod live;
pub(super) mod login;
pub(super) mod metrics;
pub(super) mod peers;
pub(super) mod play;
pub(super) mod previews;
pub(super) mod session;
pub(super) mod sessions;
pub(super) mod status;
