//! Settings of the service: flags, then environment (`CAIRN_…`), then a TOML file, then the defaults.

mod checks;
mod error;
mod settings;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use axum::http::HeaderValue;

use checks::{both, listed, origin, rate, within};
pub use error::ConfigError;
pub use settings::Settings;

use crate::http::{ConnectionLimits, LoadLimits, Proxies, RateLimits};
use crate::jobs::webhooks::{CourierOptions, Targets};
use crate::jobs::{ExportLimits, IntakeLimits, Isolated, WorkerOptions};
use crate::project::Limits;

/// What the service runs with.
#[derive(Debug, Clone)]
pub struct Config {
    /// Address to listen on.
    pub listen: SocketAddr,
    /// Directory of all state.
    pub data: PathBuf,
    /// Threads that compute; 0 is one for each core.
    pub threads: usize,
    /// What is taken in.
    pub intake: IntakeLimits,
    /// How long an upload in several requests is kept without being continued.
    pub upload_expiry: Duration,
    /// The worker pool.
    pub workers: WorkerOptions,
    /// Whether requests without a key are served whoever sends them. If not, then only those from this machine, and only
    /// until the first key is made.
    pub allow_anonymous: bool,
    /// Certificate chain and private key, PEM files; without them connections are not encrypted.
    pub tls: Option<(PathBuf, PathBuf)>,
    /// Origins whose pages may use the API.
    pub origins: Vec<HeaderValue>,
    /// What connections may do.
    pub connections: ConnectionLimits,
    /// How often one address may ask.
    pub rates: RateLimits,
    /// Requests a second from which on jobs leave a core to answers; 0: never.
    pub spare_core_at: u64,
    /// Who is believed when it says for whom it asks.
    pub proxies: Proxies,
    /// When no more work is taken on.
    pub load: LoadLimits,
    /// What files that are made for download may take of the disk.
    pub exports: ExportLimits,
    /// What each project may have.
    pub project_limits: Limits,
    /// How webhooks are told.
    pub webhooks: CourierOptions,
    /// Whether logs are JSON.
    pub log_json: bool,
}

/// The directory of all state, unless a setting says otherwise.
pub const DEFAULT_DATA: &str = "cairn-data";

impl Settings {
    /// Checks what is given and fills in the defaults.
    pub fn resolve(self) -> Result<Config, ConfigError> {
        let workers = self.workers.map_or(2, |n| n as u64);
        let threads = self.threads.map_or(0, |n| n as u64);
        let seconds = |setting, given: Option<u64>, default| {
            Ok(Duration::from_secs(within(setting, given.unwrap_or(default), 1, 86_400)?))
        };
        let memory_bytes = within(
            "worker-memory-bytes",
            self.worker_memory_bytes.unwrap_or_else(|| share_of_machine(workers)),
            LEAST_MEMORY,
            i64::MAX as u64,
        )?;
        let max_points = within("max-points", self.max_points.unwrap_or(200_000_000), 1, u32::MAX.into())?;
        let free_bytes = self.min_free_bytes.unwrap_or(1 << 30);
        let isolated = self.program.map(|program| Isolated {
            which: self.isolation.unwrap_or_default(),
            program,
            threads: threads as usize,
            log_json: self.log_json.unwrap_or(false),
        });
        Ok(Config {
            listen: self.listen.unwrap_or_else(|| SocketAddr::from(([127, 0, 0, 1], 8080))),
            data: self.data.unwrap_or_else(|| PathBuf::from(DEFAULT_DATA)),
            threads: within("threads", threads, 0, 1024)? as usize,
            intake: IntakeLimits {
                max_bytes: within(
                    "max-upload-bytes",
                    self.max_upload_bytes.unwrap_or(16 << 30),
                    1,
                    // The sum over all that a project may have begun must be a number as well.
                    1 << 48,
                )?,
                idle: seconds("upload-idle-seconds", self.upload_idle_seconds, 60)?,
                free_bytes,
            },
            upload_expiry: Duration::from_hours(within(
                "upload-expiry-hours",
                self.upload_expiry_hours.unwrap_or(168),
                1,
                87_600,
            )?),
            workers: WorkerOptions {
                workers: within("workers", workers, 1, 256)? as usize,
                lease: seconds("lease-seconds", self.lease_seconds, 60)?,
                poll: seconds("poll-seconds", self.poll_seconds, 2)?,
                progress_every: Duration::from_millis(250),
                batch: within("batch", self.batch.unwrap_or(32).into(), 1, 1000)? as u32,
                max_points: max_points.min(memory_bytes / BYTES_PER_POINT),
                memory_bytes,
                job_limit: seconds("job-seconds", self.job_seconds, 7200)?,
                isolated,
                collect_every: Duration::from_secs(10),
                grace: Duration::from_secs(20),
            },
            allow_anonymous: self.allow_anonymous.unwrap_or(false),
            tls: both(self.tls_cert, self.tls_key)?,
            origins: self
                .cors_origins
                .unwrap_or_default()
                .iter()
                .map(|o| origin(o))
                .collect::<Result<_, _>>()?,
            connections: ConnectionLimits {
                most: within("max-connections", self.max_connections.unwrap_or(1024), 1, 1 << 20)? as usize,
                most_per_address: within(
                    "max-connections-per-address",
                    self.max_connections_per_address.unwrap_or(256),
                    1,
                    1 << 20,
                )? as usize,
                idle: seconds("idle-seconds", self.idle_seconds, 60)?,
            },
            rates: RateLimits {
                requests_per_second: rate("requests-per-second", self.requests_per_second.unwrap_or(200))?,
                failures_per_minute: rate("failures-per-minute", self.failures_per_minute.unwrap_or(30))?,
            },
            spare_core_at: within("spare-core-at", self.spare_core_at.unwrap_or(20), 0, 1 << 20)?,
            proxies: Proxies(listed("trusted-proxies", self.trusted_proxies)?),
            load: LoadLimits {
                open_jobs: within("max-open-jobs", self.max_open_jobs.unwrap_or(100_000), 1, 1 << 40)?,
                free_bytes,
            },
            exports: ExportLimits {
                bytes: self.max_export_bytes.unwrap_or(16 << 30),
                free_bytes: free_bytes.saturating_mul(2),
            },
            project_limits: Limits {
                bytes: self.project_max_bytes,
                scans: self.project_max_scans,
                queued_jobs: self.project_max_queued_jobs,
                open_uploads: Some(self.project_max_open_uploads.unwrap_or(1000)),
            },
            webhooks: CourierOptions {
                targets: Targets {
                    hosts: listed("webhook-hosts", self.webhook_hosts)?,
                    networks: listed("webhook-networks", self.webhook_networks)?,
                },
                pause: seconds("webhook-retry-seconds", self.webhook_retry_seconds, 10)?,
            },
            log_json: self.log_json.unwrap_or(false),
        })
    }
}

/// What a worker needs at least, whatever it works on, bytes.
const LEAST_MEMORY: u64 = 256 << 20;
/// What decoding and preparing a scan takes at its peak, bytes for a point (measured, see docs/operations.md).
const BYTES_PER_POINT: u64 = 120;

/// Memory of this machine, or of the container if that is less, bytes; 8 GiB where it is not told.
fn machine_memory() -> u64 {
    let container = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok();
    let container = container.and_then(|text| text.trim().parse().ok()).unwrap_or(u64::MAX);
    let info = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let line = info.lines().find_map(|line| line.strip_prefix("MemTotal:"));
    let kib: Option<u64> = line.and_then(|line| line.trim().trim_end_matches(" kB").parse().ok());
    kib.map_or(8 << 30, |kib| kib.saturating_mul(1024)).min(container)
}

/// What each of so many workers may use of this machine's memory, bytes: three quarters of it between them and the processes that wait,
/// which take a quarter of one's share while all are at work.
fn share_of_machine(workers: u64) -> u64 {
    (machine_memory() / (4 * workers + 1) * 3).max(LEAST_MEMORY)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_given_has_a_default_and_numbers_that_make_no_sense_are_refused() {
        let config = Settings { workers: Some(3), ..Settings::default() }.resolve().unwrap();
        assert_eq!((config.workers.workers, config.workers.lease), (3, Duration::from_mins(1)));
        let message = Settings { workers: Some(0), ..Settings::default() }.resolve().unwrap_err().to_string();
        assert_eq!(message, "workers is 0; it must be between 1 and 256");
    }

    #[test]
    fn downloads_leave_more_of_the_disk_than_uploads_need() {
        let config = Settings { min_free_bytes: Some(1000), ..Settings::default() }.resolve().unwrap();
        assert_eq!((config.intake.free_bytes, config.exports.free_bytes), (1000, 2000));
        let limited = Settings { max_export_bytes: Some(5), ..Settings::default() }.resolve().unwrap();
        assert_eq!(limited.exports.bytes, 5);
    }

    #[test]
    fn workers_share_the_memory_of_the_machine() {
        let of = |workers| Settings { workers: Some(workers), ..Settings::default() }.resolve().unwrap();
        for workers in [1, 4, 256] {
            let share = of(workers).workers.memory_bytes;
            let all = share * workers as u64 + share / 4;
            assert!(share == LEAST_MEMORY || all <= machine_memory() / 4 * 3, "{workers}: {share}");
        }
        assert!(of(4).workers.memory_bytes <= of(1).workers.memory_bytes);
    }

    #[test]
    fn half_of_tls_and_what_is_no_origin_are_refused() {
        let half = Settings { tls_cert: Some("a.pem".into()), ..Settings::default() };
        assert!(matches!(half.resolve(), Err(ConfigError::HalfTls)));
        let with = |origin: &str| {
            Settings { cors_origins: Some(vec![origin.to_owned()]), ..Settings::default() }.resolve()
        };
        assert_eq!(with("https://Viewer.example/").unwrap().origins, ["https://viewer.example"]);
        for bad in [
            "*",
            "viewer.example",
            "https://a/b",
            "https://",
            "null",
            "ftp://a",
            "https://a@b",
            "https://a b",
        ] {
            assert!(matches!(with(bad), Err(ConfigError::NoOrigin(_))), "{bad}");
        }
    }
}
