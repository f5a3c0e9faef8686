//! Limits on the memory of scenes and render targets, derived from the memory of the machine, of its control group and of
//! the GPU, and from the resource limits of the process, unless the configuration sets them.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustix::process::Resource;

use crate::config::Config;
use modalcast_model::memory::{MemoryBudget, MemoryKind};

/// Memory that is assumed if the operating system does not tell it.
const UNKNOWN_MEMORY_BYTES: u64 = 4 << 30;

/// Limits in bytes. Without a GPU whose memory is known, `device` limits no scene: what a scene has on the device then
/// counts as host memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryLimits {
    /// Host memory of all scenes together.
    pub host: u64,
    /// Host memory of one scene.
    pub scene_host: u64,
    /// Device memory of all scenes together.
    pub device: u64,
    /// Device memory of one scene.
    pub scene_device: u64,
    /// Memory of all render targets together.
    pub render_targets: u64,
    /// Whether scenes have device memory of their own.
    pub has_device: bool,
}

impl MemoryLimits {
    /// The limits of this machine. `device_bytes` is the memory of the GPU that deforms and draws, if there is one.
    pub(super) fn new(config: &Config, device_bytes: Option<u64>) -> Self {
        Self::of_machine(config, host_memory_bytes(), device_bytes)
    }

    /// By default, all scenes have half of the memory, one scene has half of that, and render targets have a quarter. The
    /// rest is for messages, replies, encoders and the program.
    fn of_machine(config: &Config, host_bytes: u64, device_bytes: Option<u64>) -> Self {
        let shared_bytes = device_bytes.unwrap_or(host_bytes);
        let host = config.scenes_host_bytes.unwrap_or(host_bytes / 2);
        let device = config.scenes_device_bytes.unwrap_or(shared_bytes / 2);
        Self {
            host,
            scene_host: config.scene_host_bytes.unwrap_or(host / 2).min(host),
            device,
            scene_device: config.scene_device_bytes.unwrap_or(device / 2).min(device),
            render_targets: config.render_target_bytes.unwrap_or(shared_bytes / 4),
            has_device: device_bytes.is_some(),
        }
    }

    /// The budget of the scenes' host memory.
    pub(super) fn host_budget(&self) -> Arc<MemoryBudget> {
        MemoryBudget::new(MemoryKind::Host, self.host, self.scene_host)
    }

    /// The budget of the scenes' device memory.
    pub(super) fn device_budget(&self) -> Arc<MemoryBudget> {
        MemoryBudget::new(MemoryKind::Device, self.device, self.scene_device)
    }

    /// The budget of the render targets. One frame may use all of it.
    pub(super) fn render_target_budget(&self) -> Arc<MemoryBudget> {
        MemoryBudget::new(MemoryKind::RenderTargets, self.render_targets, self.render_targets)
    }
}

/// The memory in bytes that this process may use: the least of the machine's memory, the limits of its control group and
/// of the groups that contain it, and what the resource limits of the process leave.
fn host_memory_bytes() -> u64 {
    let read = |path: &Path| fs::read_to_string(path).ok();
    let machine = read(Path::new("/proc/meminfo")).and_then(|text| parse_size(&text, "MemTotal"));
    let groups = read(Path::new("/proc/self/cgroup")).unwrap_or_default();
    let group_limits = limit_files(&groups).into_iter().filter_map(|path| parse_limit(&read(&path)?));
    let status = read(Path::new("/proc/self/status")).unwrap_or_default();
    let resource_limits = [Resource::As, Resource::Data].map(|resource| rustix::process::getrlimit(resource).current);
    group_limits
        .chain(machine)
        .chain(unused_address_space(resource_limits, &status))
        .min()
        .unwrap_or(UNKNOWN_MEMORY_BYTES)
}

/// What the limits on the address space (`ulimit -v`) and on private memory (`ulimit -d`) leave, in bytes. Libraries,
/// stacks of threads and drivers have taken a part before the first scene is opened. `status` is /proc/self/status.
fn unused_address_space(limits: [Option<u64>; 2], status: &str) -> impl Iterator<Item = u64> {
    let unused = |(limit, key): (Option<u64>, &str)| Some(limit?.saturating_sub(parse_size(status, key)?));
    limits.into_iter().zip(["VmSize", "VmData"]).filter_map(unused)
}

/// The value of a line `KEY: N kB` in a file of /proc, in bytes.
fn parse_size(text: &str, key: &str) -> Option<u64> {
    let value = text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    value.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

/// A limit in bytes. `max` of version 2 means no limit; version 1 has a very large number instead.
fn parse_limit(text: &str) -> Option<u64> {
    text.trim().parse().ok()
}

/// The files that may limit the memory of a process, by its /proc/self/cgroup: those of its group and of all groups above
/// it. In a container, the path of the group may not exist, and the root then has the limit of the container.
fn limit_files(groups: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for line in groups.lines() {
        // Number of the hierarchy, its controllers, path of the group. Version 2 has the number 0 and no controllers.
        let mut fields = line.splitn(3, ':');
        let (Some(number), Some(controllers), Some(group)) = (fields.next(), fields.next(), fields.next()) else {
            continue;
        };
        let (root, file) = if number == "0" && controllers.is_empty() {
            ("/sys/fs/cgroup", "memory.max")
        } else if controllers.split(',').any(|controller| controller == "memory") {
            ("/sys/fs/cgroup/memory", "memory.limit_in_bytes")
        } else {
            continue;
        };
        let ancestors = Path::new(group.trim_start_matches('/')).ancestors();
        files.extend(ancestors.map(|ancestor| Path::new(root).join(ancestor).join(file)));
    }
    files
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_shares_of_the_memory_unless_they_are_set() {
        let limits = MemoryLimits::of_machine(&Config::default(), 800, Some(4000));
        let expected = MemoryLimits {
            host: 400,
            scene_host: 200,
            device: 2000,
            scene_device: 1000,
            render_targets: 1000,
            has_device: true,
        };
        assert_eq!(limits, expected);
        let config = Config { scenes_host_bytes: Some(100), scene_host_bytes: Some(300), ..Config::default() };
        let limits = MemoryLimits::of_machine(&config, 800, None);
        assert_eq!((limits.host, limits.scene_host, limits.render_targets), (100, 100, 200));
    }

    #[test]
    fn limit_files_of_both_versions_include_the_groups_above() {
        let groups = "9:name=systemd:/\n5:cpu,memory:/a/b\n0::/c\n";
        let expected = [
            "/sys/fs/cgroup/memory/a/b/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/a/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/memory.limit_in_bytes",
            "/sys/fs/cgroup/c/memory.max",
            "/sys/fs/cgroup/memory.max",
        ];
        assert_eq!(limit_files(groups), expected.map(PathBuf::from));
        assert!(limit_files("").is_empty() && limit_files("x\n1:cpu").is_empty());
    }

    #[test]
    fn resource_limits_leave_what_the_process_has_not_taken() {
        let status = "Name:\tx\nVmPeak:\t9 kB\nVmSize:\t    3 kB\nVmData:\t    1 kB\n";
        let unused = |limits| unused_address_space(limits, status).collect::<Vec<_>>();
        assert_eq!(unused([Some(8192), None]), [5120]);
        assert_eq!(unused([Some(1024), Some(8192)]), [0, 7168]);
        assert!(unused([None, None]).is_empty());
    }

    #[test]
    fn sizes_are_parsed_in_their_units() {
        let text = "MemTotalHuge: 3 kB\nMemFree: 1 kB\nMemTotal:       24683520 kB\n";
        assert_eq!(parse_size(text, "MemTotal"), Some(24_683_520 * 1024));
        assert_eq!([parse_limit("1073741824\n"), parse_limit("max\n"), parse_limit("")], [Some(1 << 30), None, None]);
        assert!(host_memory_bytes() > 0);
    }
}
