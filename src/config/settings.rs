//! What may be set: flags, environment and file have the same names.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Deserialize;

use super::ConfigError;
use crate::jobs::Isolation;

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
    /// Threads that compute, in the service and in each process of jobs [default: one for each core]
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
    /// Seconds after which an upload is given up of which no further kilobyte came [default: 60]
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
    /// Memory that each worker may use, bytes [default: three quarters of the machine's, shared by the workers]
    #[arg(long, env = "CAIRN_WORKER_MEMORY_BYTES", value_name = "BYTES")]
    pub worker_memory_bytes: Option<u64>,
    /// Seconds that a job may take [default: 7200]
    #[arg(long, env = "CAIRN_JOB_SECONDS", value_name = "SECONDS")]
    pub job_seconds: Option<u64>,
    /// Which jobs are done by other processes than the service: never any, suspects (a process died of them before), all
    /// [default: all]
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
    /// Connections at once from one address that is no trusted proxy; more are closed [default: 256]
    #[arg(long, env = "CAIRN_MAX_CONNECTIONS_PER_ADDRESS", value_name = "N")]
    pub max_connections_per_address: Option<u64>,
    /// Requests a second from one address, ten seconds' worth of them at once; more are refused with 429, 0 is no limit [default: 200]
    #[arg(long, env = "CAIRN_REQUESTS_PER_SECOND", value_name = "N")]
    pub requests_per_second: Option<u64>,
    /// Requests a second from which on jobs leave one core to answers, if they come over at least eight connections; 0: never [default: 20]
    #[arg(long, env = "CAIRN_SPARE_CORE_AT", value_name = "N")]
    pub spare_core_at: Option<u64>,
    /// Requests a minute from one address with keys that open nothing; more are refused with 429, 0 is no limit [default: 30]
    #[arg(long, env = "CAIRN_FAILURES_PER_MINUTE", value_name = "N")]
    pub failures_per_minute: Option<u64>,
    /// Proxies whose `X-Forwarded-For` is believed, such as 127.0.0.1 or 10.1.0.0/16, separated by commas [default: none]
    #[arg(long, env = "CAIRN_TRUSTED_PROXIES", value_name = "NETWORKS", value_delimiter = ',')]
    pub trusted_proxies: Option<Vec<String>>,
    /// Seconds for which a connection may be silent between requests, take for the head of one, or for the next kilobyte of an answer [default: 60]
    #[arg(long, env = "CAIRN_IDLE_SECONDS", value_name = "SECONDS")]
    pub idle_seconds: Option<u64>,
    /// Jobs of all projects that may wait or run; with more, work is refused with 503 [default: 100000]
    #[arg(long, env = "CAIRN_MAX_OPEN_JOBS", value_name = "N")]
    pub max_open_jobs: Option<u64>,
    /// Bytes of disk that must be free; with less, work is refused with 503 [default: 1073741824, which is 1 GiB]
    #[arg(long, env = "CAIRN_MIN_FREE_BYTES", value_name = "BYTES")]
    pub min_free_bytes: Option<u64>,
    /// Bytes that merged clouds and pictures may have together; the oldest go first [default: 17179869184, which is 16 GiB]
    #[arg(long, env = "CAIRN_MAX_EXPORT_BYTES", value_name = "BYTES")]
    pub max_export_bytes: Option<u64>,
    /// Bytes of scans that a project may have [default: no limit]
    #[arg(long, env = "CAIRN_PROJECT_MAX_BYTES", value_name = "BYTES")]
    pub project_max_bytes: Option<u64>,
    /// Scans that a project may have [default: no limit]
    #[arg(long, env = "CAIRN_PROJECT_MAX_SCANS", value_name = "N")]
    pub project_max_scans: Option<u64>,
    /// Jobs of a project that may wait or run [default: no limit]
    #[arg(long, env = "CAIRN_PROJECT_MAX_QUEUED_JOBS", value_name = "N")]
    pub project_max_queued_jobs: Option<u64>,
    /// Resumable uploads of a project that may be begun and not complete [default: 1000]
    #[arg(long, env = "CAIRN_PROJECT_MAX_OPEN_UPLOADS", value_name = "N")]
    pub project_max_open_uploads: Option<u64>,
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
            max_connections_per_address: self
                .max_connections_per_address
                .or(other.max_connections_per_address),
            requests_per_second: self.requests_per_second.or(other.requests_per_second),
            spare_core_at: self.spare_core_at.or(other.spare_core_at),
            failures_per_minute: self.failures_per_minute.or(other.failures_per_minute),
            trusted_proxies: self.trusted_proxies.or(other.trusted_proxies),
            idle_seconds: self.idle_seconds.or(other.idle_seconds),
            max_open_jobs: self.max_open_jobs.or(other.max_open_jobs),
            min_free_bytes: self.min_free_bytes.or(other.min_free_bytes),
            max_export_bytes: self.max_export_bytes.or(other.max_export_bytes),
            project_max_bytes: self.project_max_bytes.or(other.project_max_bytes),
            project_max_scans: self.project_max_scans.or(other.project_max_scans),
            project_max_queued_jobs: self.project_max_queued_jobs.or(other.project_max_queued_jobs),
            project_max_open_uploads: self.project_max_open_uploads.or(other.project_max_open_uploads),
            webhook_hosts: self.webhook_hosts.or(other.webhook_hosts),
            webhook_networks: self.webhook_networks.or(other.webhook_networks),
            webhook_retry_seconds: self.webhook_retry_seconds.or(other.webhook_retry_seconds),
            log_json: self.log_json.or(other.log_json),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_win_over_the_file_and_unknown_settings_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cairn.toml");
        std::fs::write(&path, "listen = \"0.0.0.0:9000\"\nworkers = 7\n").unwrap();
        let flags = Settings { workers: Some(3), ..Settings::default() };
        let settings = flags.or(Settings::from_file(&path).unwrap());
        assert_eq!(settings.workers, Some(3));
        assert_eq!(settings.listen, Some(SocketAddr::from(([0, 0, 0, 0], 9000))));
        std::fs::write(&path, "lisen = \"0.0.0.0:9000\"\n").unwrap();
        assert!(Settings::from_file(&path).unwrap_err().to_string().contains("lisen"));
    }
}
