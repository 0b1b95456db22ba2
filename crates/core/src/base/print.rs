// SPDX-License-Identifier: MIT OR Apache-2.0
//! Text that may be printed to a terminal, or put into a page.

/// A text without what steers a terminal: it may hold what is in somebody else's file. Its lines stay lines; what must be one
/// goes through [`one_line`](super::ids::one_line).
pub fn harmless(text: impl std::fmt::Display) -> String {
    let text = text.to_string();
    let steers = |c: char| super::ids::is_control(c) && !matches!(c, '\n' | '\t');
    if text.contains(steers) { text.replace(steers, "\u{fffd}") } else { text }
}

/// A text as HTML, SVG and XML have it, in elements and in quoted attributes.
pub fn html(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
        .replace('\'', "&#39;")
}
