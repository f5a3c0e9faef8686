//! Options and signals that the commands share.

use std::future::Future;
use std::time::Duration;

use clap::Args;
use modalcast_client::Client;
use modalcast_recording::{Error, Result};
use tokio::signal::unix::{SignalKind, signal};

/// The server to connect to.
#[derive(Debug, Args)]
pub(crate) struct ServerOptions {
    /// URL of the server: http://HOST:PORT, https://HOST:PORT or unix:PATH.
    #[arg(long, env = "MODALCAST_SERVER", default_value = "http://127.0.0.1:50051")]
    server: String,
    /// How long to retry until the server answers, in seconds.
    #[arg(long, default_value_t = 0.0, value_parser = parse_seconds)]
    wait: f64,
}

impl ServerOptions {
    pub(crate) async fn connect(&self) -> Result<Client> {
        Ok(Client::connect_with_retry(&self.server, Duration::from_secs_f64(self.wait)).await?)
    }
}

/// Waits for Ctrl-C or SIGTERM.
pub(crate) fn termination_signal() -> Result<impl Future<Output = ()>> {
    let install = |kind| signal(kind).map_err(|error| output_error(&error));
    let (mut interrupt, mut terminate) = (install(SignalKind::interrupt())?, install(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

pub(crate) fn output_error(error: &std::io::Error) -> Error {
    Error::File { path: "modalcast-record".to_owned(), reason: error.to_string() }
}

/// Parses a factor of slow motion.
pub(crate) fn parse_slow(text: &str) -> Result<f64, String> {
    let factor = text.parse().ok().filter(|factor| (1e-3..=1e6).contains(factor));
    factor.ok_or_else(|| "expected a factor, 0.001 to 1000000".into())
}

pub(crate) fn parse_seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.0..=1e6).contains(seconds));
    seconds.ok_or_else(|| "expected seconds, 0 to 1000000".into())
}
