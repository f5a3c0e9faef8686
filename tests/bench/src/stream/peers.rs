//! The roles of `modalcast-report` as a child process of itself: `modalcast-report peer JOB`, where JOB is JSON.

pub(super) mod proxy;
pub(in crate::stream) mod socket;
pub(super) mod viewer;

use serde::{Deserialize, Serialize};

use super::processes::{Process, Program, arguments};
use modalcast_model::error::{Result, fault_in};

/// What a child process does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum PeerJob {
    Viewer(viewer::ViewerJob),
    SocketSource(socket::SocketJob),
    Proxy(proxy::ProxyJob),
}

impl PeerJob {
    /// Starts a child process with this job.
    ///
    /// # Errors
    /// Those of [`Process::start`].
    pub(super) fn start(&self) -> Result<Process> {
        let json = serde_json::to_string(self).map_err(fault_in("report"))?;
        Process::start(Program::Report, &arguments([&"peer", &json]))
    }
}

/// Does the job in this process until it is done. A proxy runs until the process is killed.
///
/// # Errors
/// `Fault` when the connection to another process fails.
pub(crate) fn run(job: &PeerJob) -> Result<()> {
    match job {
        PeerJob::SocketSource(job) => socket::run_source(job),
        PeerJob::Viewer(job) => start_runtime()?.block_on(viewer::run(job)),
        PeerJob::Proxy(job) => start_runtime()?.block_on(proxy::run(job)),
    }
}

/// A runtime for clients and servers.
pub(super) fn start_runtime() -> Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(fault_in("report"))
}
