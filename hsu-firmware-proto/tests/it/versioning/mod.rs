//! One file of golden bytes per released protocol version.
mod v01;
