//! TLS by rustls, from a certificate chain and a key in PEM files. Certificates are renewed while the service runs: the files are read
//! again when they change, and at SIGHUP. Connections that are open keep theirs.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use rustls::ServerConfig;
use rustls::crypto::ring::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, pem};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// Why connections cannot be encrypted.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or holds no PEM of the kind.
    #[error("{file}: {source}")]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why.
        source: pem::Error,
    },
    /// The certificate file is empty.
    #[error("{0} holds no certificate")]
    NoCertificate(PathBuf),
    /// Certificate and key do not fit, or are of a kind that is not known.
    #[error("certificate and key cannot be used: {0}")]
    Unusable(#[from] rustls::Error),
    /// The signal that has the files read again cannot be listened for.
    #[error("SIGHUP cannot be listened for: {0}")]
    Signal(#[from] std::io::Error),
}

/// How often the files are looked at.
const LOOK: Duration = Duration::from_secs(30);

/// A certificate and its key, as they are in their files.
#[derive(Debug)]
pub struct Certificates {
    chain: PathBuf,
    key: PathBuf,
    current: Arc<Current>,
    acceptor: Arc<ServerConfig>,
    /// The files as they were before they were read last.
    known: Stamp,
    hangups: Signal,
}

/// Changes with the files, also when links are turned to others: when each was written, and which it is.
type Stamp = [Option<(i64, i64, u64)>; 2];

/// What new connections are shown.
#[derive(Debug)]
struct Current(RwLock<Arc<CertifiedKey>>);

impl ResolvesServerCert for Current {
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner)))
    }
}

impl Certificates {
    /// Reads the certificate chain, the server's own first, and its private key (PKCS #8, PKCS #1 or SEC1), and begins to listen for
    /// SIGHUP.
    pub fn open(chain: &Path, key: &Path) -> Result<Self, TlsError> {
        let known = stamp(chain, key);
        let current = Arc::new(Current(RwLock::new(Arc::new(read(chain, key)?))));
        let mut config = ServerConfig::builder_with_provider(Arc::new(default_provider()))
            .with_safe_default_protocol_versions()?
            .with_no_client_auth()
            .with_cert_resolver(Arc::<Current>::clone(&current));
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self {
            chain: chain.to_owned(),
            key: key.to_owned(),
            current,
            acceptor: Arc::new(config),
            known,
            hangups: signal(SignalKind::hangup())?,
        })
    }

    /// What takes encrypted connections, always with the newest certificate.
    pub(super) fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(Arc::clone(&self.acceptor))
    }

    /// Reads the files again whenever they change, until `stop` is cancelled. As long as they cannot be used, such as when only one of
    /// them was replaced yet, the certificate before stays.
    pub(super) async fn renew(mut self, stop: CancellationToken) {
        loop {
            let asked = tokio::select! {
                _ = self.hangups.recv() => true,
                () = tokio::time::sleep(LOOK) => false,
                () = stop.cancelled() => return,
            };
            let found = stamp(&self.chain, &self.key);
            if !asked && found == self.known {
                continue;
            }
            match read(&self.chain, &self.key) {
                Ok(new) => {
                    *self.current.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(new);
                    self.known = found;
                    tracing::info!(file = %self.chain.display(), "the certificate was read again");
                }
                Err(error) => {
                    tracing::error!(%error, "the new certificate cannot be used; the old one stays");
                }
            }
        }
    }
}

fn stamp(chain: &Path, key: &Path) -> Stamp {
    [chain, key].map(|file| fs::metadata(file).ok().map(|m| (m.mtime(), m.mtime_nsec(), m.ino())))
}

fn read(chain: &Path, key: &Path) -> Result<CertifiedKey, TlsError> {
    let unreadable = |file: &Path| {
        let file = file.to_owned();
        |source| TlsError::Unreadable { file, source }
    };
    let certificates = CertificateDer::pem_file_iter(chain)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(unreadable(chain))?;
    if certificates.is_empty() {
        return Err(TlsError::NoCertificate(chain.to_owned()));
    }
    let secret = PrivateKeyDer::from_pem_file(key).map_err(unreadable(key))?;
    Ok(CertifiedKey::from_der(certificates, secret, &default_provider())?)
}
