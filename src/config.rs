//! Settings of the service: flags, then environment (`CAIRN_…`), then a TOML file, then the defaults.

use std::fmt::Display;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use axum::http::HeaderValue;
use axum::http::uri::Authority;
use clap::Args;
use serde::Deserialize;

use crate::http::{ConnectionLimits, LoadLimits};
use crate::jobs::webhooks::{CourierOptions, Targets};
use crate::jobs::{Isolated, Isolation, WorkerOptions};
use crate::project::Limits;

/// Every setting, each possibly not given. The same names serve as flags, in the environment and in the file.
#[derive(Debug, Clone, Default, PartialEq, Args, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Settings {
    /// Address to listen on; port 0 takes a free one [default: 127.0.0.1:8080]
    #[arg(long, env = "CAIRN_LISTEN", value_name = "ADDRESS")]
    pub listen: Option<SocketAddr>,
    /// Directory of all state [default: ./cairn-data]
    #[arg(long, env = "CAIRN_DATA", value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Jobs at once [default: 2]
    #[arg(long, env = "CAIRN_WORKERS", value_name = "N")]
    pub workers: Option<usize>,
    /// Threads that compute [default: one for each core]
    #[arg(long, env = "CAIRN_THREADS", value_name = "N")]
    pub threads: Option<usize>,
    /// Largest upload, bytes [default: 17179869184, which is 16 GiB]
    #[arg(long, env = "CAIRN_MAX_UPLOAD_BYTES", value_name = "BYTES")]
    pub max_upload_bytes: Option<u64>,
    /// Most points that one scan may have [default: 200000000]
    #[arg(long, env = "CAIRN_MAX_POINTS", value_name = "N")]
    pub max_points: Option<u64>,
    /// Seconds after which a silent worker is taken for dead [default: 60]
    #[arg(long, env = "CAIRN_LEASE_SECONDS", value_name = "SECONDS")]
    pub lease_seconds: Option<u64>,
    /// Seconds between looks at the queue when nothing happens [default: 2]
    #[arg(long, env = "CAIRN_POLL_SECONDS", value_name = "SECONDS")]
    pub poll_seconds: Option<u64>,
    /// Seconds after which an upload that sends nothing is given up [default: 60]
    #[arg(long, env = "CAIRN_UPLOAD_IDLE_SECONDS", value_name = "SECONDS")]
    pub upload_idle_seconds: Option<u64>,
    /// Hours after which a resumable upload that is not continued is forgotten [default: 168, which is a week]
    #[arg(long, env = "CAIRN_UPLOAD_EXPIRY_HOURS", value_name = "HOURS")]
    pub upload_expiry_hours: Option<u64>,
    /// Scans that one mapping job takes at once, at most [default: 32]
    #[arg(long, env = "CAIRN_BATCH", value_name = "N")]
    pub batch: Option<u32>,
    /// Serve requests without a key, whoever sends them [default: false]
    #[arg(long, env = "CAIRN_ALLOW_ANONYMOUS", value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    pub allow_anonymous: Option<bool>,
    /// Memory that the process of one job may use, bytes [default: three quarters of the machine's]
    #[arg(long, env = "CAIRN_WORKER_MEMORY_BYTES", value_name = "BYTES")]
    pub worker_memory_bytes: Option<u64>,
    /// Seconds that a job may take [default: 7200]
    #[arg(long, env = "CAIRN_JOB_SECONDS", value_name = "SECONDS")]
    pub job_seconds: Option<u64>,
    /// Which jobs get a process of their own: never, suspects (a process died of them before), uploads (these, and all that read
    /// an upload for the first time) [default: uploads]
    #[arg(long, env = "CAIRN_ISOLATION", value_name = "WHICH")]
    pub isolation: Option<Isolation>,
    /// This program, if it may be started again for jobs that need a process of their own. No setting: whoever runs the service
    /// says so.
    #[arg(skip)]
    #[serde(skip)]
    pub program: Option<PathBuf>,
    /// PEM file with the certificate chain, the server's own first; with `tls-key`, connections are encrypted
    #[arg(long, env = "CAIRN_TLS_CERT", value_name = "FILE")]
    pub tls_cert: Option<PathBuf>,
    /// PEM file with the private key of the certificate
    #[arg(long, env = "CAIRN_TLS_KEY", value_name = "FILE")]
    pub tls_key: Option<PathBuf>,
    /// Origins whose pages may use the API, such as `https://viewer.example`, separated by commas [default: none]
    #[arg(long, env = "CAIRN_CORS_ORIGINS", value_name = "ORIGINS", value_delimiter = ',')]
    pub cors_origins: Option<Vec<String>>,
    /// Connections at once; more wait [default: 1024]
    #[arg(long, env = "CAIRN_MAX_CONNECTIONS", value_name = "N")]
    pub max_connections: Option<u64>,
    /// Seconds for which a connection may be silent between requests, take for the head of one, or not read an answer [default: 60]
    #[arg(long, env = "CAIRN_IDLE_SECONDS", value_name = "SECONDS")]
    pub idle_seconds: Option<u64>,
    /// Jobs of all projects that may wait or run; with more, work is refused with 503 [default: 100000]
    #[arg(long, env = "CAIRN_MAX_OPEN_JOBS", value_name = "N")]
    pub max_open_jobs: Option<u64>,
    /// Bytes of disk that must be free; with less, work is refused with 503 [default: 1073741824, which is 1 GiB]
    #[arg(long, env = "CAIRN_MIN_FREE_BYTES", value_name = "BYTES")]
    pub min_free_bytes: Option<u64>,
    /// Bytes of scans that a project may have [default: no limit]
    #[arg(long, env = "CAIRN_PROJECT_MAX_BYTES", value_name = "BYTES")]
    pub project_max_bytes: Option<u64>,
    /// Scans that a project may have [default: no limit]
    #[arg(long, env = "CAIRN_PROJECT_MAX_SCANS", value_name = "N")]
    pub project_max_scans: Option<u64>,
    /// Jobs of a project that may wait or run [default: no limit]
    #[arg(long, env = "CAIRN_PROJECT_MAX_QUEUED_JOBS", value_name = "N")]
    pub project_max_queued_jobs: Option<u64>,
    /// Hosts to which webhooks may be sent, such as hooks.example.com or *.example.com, separated by commas [default: none]
    #[arg(long, env = "CAIRN_WEBHOOK_HOSTS", value_name = "HOSTS", value_delimiter = ',')]
    pub webhook_hosts: Option<Vec<String>>,
    /// Networks that are not public, but in which listed hosts may be, such as 10.1.0.0/16, separated by commas [default: none]
    #[arg(long, env = "CAIRN_WEBHOOK_NETWORKS", value_name = "NETWORKS", value_delimiter = ',')]
    pub webhook_networks: Option<Vec<String>>,
    /// Seconds until a message that a webhook did not take is sent again; doubles each time [default: 10]
    #[arg(long, env = "CAIRN_WEBHOOK_RETRY_SECONDS", value_name = "SECONDS")]
    pub webhook_retry_seconds: Option<u64>,
    /// Write logs as JSON [default: false]
    #[arg(long, env = "CAIRN_LOG_JSON", value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    pub log_json: Option<bool>,
}

/// What the service runs with.
#[derive(Debug, Clone)]
pub struct Config {
    /// Address to listen on.
    pub listen: SocketAddr,
    /// Directory of all state.
    pub data: PathBuf,
    /// Threads that compute; 0 is one for each core.
    pub threads: usize,
    /// Largest upload, bytes.
    pub max_upload_bytes: u64,
    /// How long an upload may send nothing.
    pub upload_idle: Duration,
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
    /// When no more work is taken on.
    pub load: LoadLimits,
    /// What each project may have.
    pub project_limits: Limits,
    /// How webhooks are told.
    pub webhooks: CourierOptions,
    /// Whether logs are JSON.
    pub log_json: bool,
}

/// The directory of all state, unless a setting says otherwise.
pub const DEFAULT_DATA: &str = "cairn-data";

/// Why settings are refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{file}: {source}")]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not TOML, or has a setting that does not exist.
    #[error("{file}: {source}")]
    Malformed {
        /// The file.
        file: PathBuf,
        /// Where and why.
        source: toml::de::Error,
    },
    /// A certificate without its key, or the other way round.
    #[error("tls-cert and tls-key only make sense together")]
    HalfTls,
    /// An item of a list that cannot be read.
    #[error("{setting}: `{item}`: {why}")]
    BadItem {
        /// Which setting.
        setting: &'static str,
        /// The item.
        item: String,
        /// What is wrong with it.
        why: String,
    },
    /// No origin of pages.
    #[error("`{0}` is no origin: it must be such as https://viewer.example:8443, without a path")]
    NoOrigin(String),
    /// A number that makes no sense.
    #[error("{setting} is {value}; it must be between {least} and {most}")]
    OutOfRange {
        /// Which setting.
        setting: &'static str,
        /// What it is.
        value: u64,
        /// The least.
        least: u64,
        /// The most.
        most: u64,
    },
}

impl Settings {
    /// Reads a TOML file.
    pub fn from_file(file: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(file)
            .map_err(|source| ConfigError::Unreadable { file: file.to_owned(), source })?;
        toml::from_str(&text).map_err(|source| ConfigError::Malformed { file: file.to_owned(), source })
    }

    /// These settings, and those of `other` where these say nothing.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self {
            listen: self.listen.or(other.listen),
            data: self.data.or(other.data),
            workers: self.workers.or(other.workers),
            threads: self.threads.or(other.threads),
            max_upload_bytes: self.max_upload_bytes.or(other.max_upload_bytes),
            max_points: self.max_points.or(other.max_points),
            lease_seconds: self.lease_seconds.or(other.lease_seconds),
            poll_seconds: self.poll_seconds.or(other.poll_seconds),
            upload_idle_seconds: self.upload_idle_seconds.or(other.upload_idle_seconds),
            upload_expiry_hours: self.upload_expiry_hours.or(other.upload_expiry_hours),
            batch: self.batch.or(other.batch),
            allow_anonymous: self.allow_anonymous.or(other.allow_anonymous),
            worker_memory_bytes: self.worker_memory_bytes.or(other.worker_memory_bytes),
            job_seconds: self.job_seconds.or(other.job_seconds),
            isolation: self.isolation.or(other.isolation),
            program: self.program.or(other.program),
            tls_cert: self.tls_cert.or(other.tls_cert),
            tls_key: self.tls_key.or(other.tls_key),
            cors_origins: self.cors_origins.or(other.cors_origins),
            max_connections: self.max_connections.or(other.max_connections),
            idle_seconds: self.idle_seconds.or(other.idle_seconds),
            max_open_jobs: self.max_open_jobs.or(other.max_open_jobs),
            min_free_bytes: self.min_free_bytes.or(other.min_free_bytes),
            project_max_bytes: self.project_max_bytes.or(other.project_max_bytes),
            project_max_scans: self.project_max_scans.or(other.project_max_scans),
            project_max_queued_jobs: self.project_max_queued_jobs.or(other.project_max_queued_jobs),
            webhook_hosts: self.webhook_hosts.or(other.webhook_hosts),
            webhook_networks: self.webhook_networks.or(other.webhook_networks),
            webhook_retry_seconds: self.webhook_retry_seconds.or(other.webhook_retry_seconds),
            log_json: self.log_json.or(other.log_json),
        }
    }

    /// Checks what is given and fills in the defaults.
    pub fn resolve(self) -> Result<Config, ConfigError> {
        let workers = self.workers.map_or(2, |n| n as u64);
        let threads = self.threads.map_or(0, |n| n as u64);
        let seconds = |setting, given: Option<u64>, default| {
            Ok(Duration::from_secs(within(setting, given.unwrap_or(default), 1, 86_400)?))
        };
        let memory_bytes = within(
            "worker-memory-bytes",
            self.worker_memory_bytes.unwrap_or_else(|| machine_memory() / 4 * 3),
            LEAST_MEMORY,
            i64::MAX as u64,
        )?;
        let max_points = within("max-points", self.max_points.unwrap_or(200_000_000), 1, u32::MAX.into())?;
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
            max_upload_bytes: within(
                "max-upload-bytes",
                self.max_upload_bytes.unwrap_or(16 << 30),
                1,
                i64::MAX as u64,
            )?,
            upload_idle: seconds("upload-idle-seconds", self.upload_idle_seconds, 60)?,
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
                idle: seconds("idle-seconds", self.idle_seconds, 60)?,
            },
            load: LoadLimits {
                open_jobs: within("max-open-jobs", self.max_open_jobs.unwrap_or(100_000), 1, 1 << 40)?,
                free_bytes: self.min_free_bytes.unwrap_or(1 << 30),
            },
            project_limits: Limits {
                bytes: self.project_max_bytes,
                scans: self.project_max_scans,
                queued_jobs: self.project_max_queued_jobs,
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

/// Memory of this machine, bytes; 8 GiB where it is not told.
fn machine_memory() -> u64 {
    let info = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let line = info.lines().find_map(|line| line.strip_prefix("MemTotal:"));
    let kib: Option<u64> = line.and_then(|line| line.trim().trim_end_matches(" kB").parse().ok());
    kib.map_or(8 << 30, |kib| kib * 1024).max(LEAST_MEMORY * 2)
}

fn both(
    certificate: Option<PathBuf>,
    key: Option<PathBuf>,
) -> Result<Option<(PathBuf, PathBuf)>, ConfigError> {
    match (certificate, key) {
        (Some(certificate), Some(key)) => Ok(Some((certificate, key))),
        (None, None) => Ok(None),
        _ => Err(ConfigError::HalfTls),
    }
}

fn listed<T: FromStr<Err: Display>>(
    setting: &'static str,
    items: Option<Vec<String>>,
) -> Result<Vec<T>, ConfigError> {
    let read = |item: String| {
        item.trim().parse().map_err(|why: T::Err| ConfigError::BadItem {
            setting,
            why: why.to_string(),
            item,
        })
    };
    items.unwrap_or_default().into_iter().map(read).collect()
}

/// Reads an origin as browsers send it: scheme, host, and the port unless it is the scheme's own.
fn origin(text: &str) -> Result<HeaderValue, ConfigError> {
    let bad = || ConfigError::NoOrigin(text.to_owned());
    let text = text.trim().trim_end_matches('/').to_ascii_lowercase();
    let (scheme, host) = text.split_once("://").ok_or_else(bad)?;
    host.parse::<Authority>().ok().filter(|a| !a.as_str().contains('@')).ok_or_else(bad)?;
    if !matches!(scheme, "http" | "https") {
        return Err(bad());
    }
    HeaderValue::from_str(&text).map_err(|_| bad())
}

fn within(setting: &'static str, value: u64, least: u64, most: u64) -> Result<u64, ConfigError> {
    if (least..=most).contains(&value) {
        Ok(value)
    } else {
        Err(ConfigError::OutOfRange { setting, value, least, most })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_win_over_the_file_and_the_file_over_the_defaults() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cairn.toml");
        std::fs::write(&path, "listen = \"0.0.0.0:9000\"\nworkers = 7\n").unwrap();
        let flags = Settings { workers: Some(3), ..Settings::default() };
        let config = flags.or(Settings::from_file(&path).unwrap()).resolve().unwrap();
        assert_eq!(config.workers.workers, 3);
        assert_eq!(config.listen, SocketAddr::from(([0, 0, 0, 0], 9000)));
        assert_eq!(config.workers.lease, Duration::from_mins(1));
    }

    #[test]
    fn unknown_settings_and_numbers_that_make_no_sense_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cairn.toml");
        std::fs::write(&path, "lisen = \"0.0.0.0:9000\"\n").unwrap();
        assert!(Settings::from_file(&path).unwrap_err().to_string().contains("lisen"));
        let settings = Settings { workers: Some(0), ..Settings::default() };
        let message = settings.resolve().unwrap_err().to_string();
        assert_eq!(message, "workers is 0; it must be between 1 and 256");
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
