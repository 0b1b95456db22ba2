// SPDX-License-Identifier: MIT OR Apache-2.0
//! Integration tests of the HSU protocol: golden bytes, framing properties, behaviour of the unit.
mod framing;
mod inputs;
mod messages;
mod time_code;
mod unit;
mod versioning;
