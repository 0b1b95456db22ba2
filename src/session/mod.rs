//! One capture on one node: the state machine and its driver.
