//! Integration tests of the HSU protocol: golden bytes, framing properties, behaviour of the unit.
