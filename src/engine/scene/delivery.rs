//! Which steps a stream carries, for writers and for subscribers.

/// Which steps a stream carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Every step, in order. A lossless subscriber that reads slowly blocks a lossless writer. If the writer is
    /// `Latest`, such a subscriber skips steps.
    Lossless,
    /// A subscriber receives the newest step, starting with the current one if the scene has had a step. Queued steps
    /// of a writer are merged into one whose effect on the state equals applying all of them in order.
    Latest,
}
