//! The API's routes, a file per resource; each has `routes()` with handlers and their description.

pub(super) mod description;
pub(super) mod login;
pub(super) mod session;
pub(super) mod status;
