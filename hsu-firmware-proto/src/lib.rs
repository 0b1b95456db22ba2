//! Wire contract and behaviour of the hardware synchronization unit (HSU).
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]
