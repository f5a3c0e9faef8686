//! Admission control of everything that is limited in number or in bytes, such as connections. A holder needs a [`Permit`]
//! of the [`PermitPool`] of its resource; [`LIMITS`] lists the resources with their limits.
//!
//! Permits are shared max-min: between principals first, then between the clients of a principal. While permits are free,
//! everybody gets one, but a single client leaves a part for others. When none is free, a client that holds fewer than
//! another one gets a permit: the one with the least progress of the client that holds the most is preempted, which ends
//! what it was granted for. Without a preemptible permit, or for a client that already has its share, it is refused.
//!
//! For resources that are returned soon, such as the bytes of replies, clients wait in a [`Queue`] instead.
//!
//! [`Admission`] lists the clients with what they hold, and ends them for an administrator.

mod account;
mod grant;
mod holdings;
mod limits;
mod metrics;
mod permit;
mod pools;
mod progress;
mod queue;
mod sharing;

pub use account::{Account, Client};
pub use holdings::{ClientHoldings, EndedClient, ResourceUse};
pub use limits::{LIMITS, Limit, WhenFull};
pub use permit::{Permit, PermitHandle, PermitPool};
pub use pools::Admission;
pub use queue::{Queue, QueueMember, Units};
