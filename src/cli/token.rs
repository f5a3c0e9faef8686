//! `modalcast token`: a new token for a principal.

use std::time::{Duration, SystemTime};

use super::{Completion, Outcome, print_line};
use crate::identity::{Role, TokenHash, new_token};
use modalcast_model::error::fault;

/// Prints a new token, and the entry for the file of principals (`serve --principals`) that makes it known to a server.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast token anna --role drive
  modalcast token dashboard --role pixels --days 90")]
pub(super) struct Args {
    /// The name of the principal, for logs.
    name: String,
    /// What the principal may do.
    #[arg(long, value_enum)]
    role: Role,
    /// Days after which the token expires. Default: never.
    #[arg(long)]
    days: Option<u32>,
}

pub(super) fn run(args: &Args) -> Outcome {
    let token = new_token()?;
    let hash = TokenHash::of(&token).ok_or_else(|| fault("token", "expected a valid token"))?;
    let end = args.days.map(|days| SystemTime::now() + Duration::from_secs(86_400 * u64::from(days)));
    let expires = end.map(|end| format!("\nexpires = \"{}\"", humantime::format_rfc3339_seconds(end)));
    print_line(format!("token for {}, shown only once:", args.name));
    print_line(&token);
    print_line("entry for the file of principals:");
    print_line(format!("[[principal]]\nname = \"{}\"\nrole = \"{}\"", args.name, args.role.name()));
    print_line(format!("[[principal.token]]\nsha256 = \"{hash}\"{}", expires.unwrap_or_default()));
    Ok(Completion::Success)
}
