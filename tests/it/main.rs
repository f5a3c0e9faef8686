//! Integration tests that need no GPU.

mod pixels;
