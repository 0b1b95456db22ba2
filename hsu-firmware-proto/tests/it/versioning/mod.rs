// SPDX-License-Identifier: MIT OR Apache-2.0
//! One file of golden bytes per released protocol version.
mod v01;
