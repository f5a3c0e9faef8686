//! The device thread and everything that talks to it.
