//! Cameras: settings, and streams through Aravis.
