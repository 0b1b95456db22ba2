// SPDX-License-Identifier: MIT OR Apache-2.0
//! Text that may be printed to a terminal, or put into a page.

/// A text without characters that control a terminal: it may quote a file of another program. Its lines stay lines;
/// what must be one line goes through [`one_line`](super::ids::one_line).
pub fn harmless(text: impl std::fmt::Display) -> String {
    let text = text.to_string();
    let controls = |c: char| super::ids::is_control(c) && !matches!(c, '\n' | '\t');
    if text.contains(controls) { text.replace(controls, "\u{fffd}") } else { text }
}

/// A text as HTML, SVG and XML have it, in elements and in quoted attributes.
pub fn html(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
        .replace('\'', "&#39;")
}
