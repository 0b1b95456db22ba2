//! Recordings: layout, writer, reader, verification.
