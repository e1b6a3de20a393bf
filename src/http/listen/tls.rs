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
            match self.read_again(asked) {
                Ok(false) => {}
                Ok(true) => tracing::info!(file = %self.chain.display(), "the certificate was read again"),
                Err(error) => {
                    tracing::error!(%error, "the new certificate cannot be used; the old one stays");
                }
            }
        }
    }

    /// Shows new connections what is in the files, if that changed or if `asked`. Returns whether they were read.
    fn read_again(&mut self, asked: bool) -> Result<bool, TlsError> {
        let found = stamp(&self.chain, &self.key);
        if !asked && found == self.known {
            return Ok(false);
        }
        let new = read(&self.chain, &self.key)?;
        *self.current.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(new);
        self.known = found;
        Ok(true)
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

#[cfg(test)]
mod tests {
    use rcgen::{CertifiedKey as Issued, generate_simple_self_signed};

    use super::*;

    /// Writes a new certificate and its key, in that order, and returns the certificate and what is to be written as key.
    fn issue(folder: &Path) -> (CertificateDer<'static>, String) {
        let Issued { cert, signing_key } = generate_simple_self_signed(["localhost".to_owned()]).unwrap();
        fs::write(folder.join("cert.pem"), cert.pem()).unwrap();
        (cert.der().clone(), signing_key.serialize_pem())
    }

    #[tokio::test]
    async fn a_certificate_whose_key_is_not_there_yet_is_not_shown_and_one_that_is_whole_is() {
        let dir = tempfile::tempdir().unwrap();
        let key = dir.path().join("key.pem");
        let (first, first_key) = issue(dir.path());
        fs::write(&key, first_key).unwrap();
        let mut certificates = Certificates::open(&dir.path().join("cert.pem"), &key).unwrap();
        let current = Arc::clone(&certificates.current);
        let shown = || current.0.read().unwrap().cert[0].clone();
        assert!(!certificates.read_again(false).unwrap(), "nothing has changed");

        let (second, second_key) = issue(dir.path());
        for asked in [true, false] {
            assert!(matches!(certificates.read_again(asked), Err(TlsError::Unusable(_))));
            assert_eq!(shown(), first);
        }
        fs::write(&key, second_key).unwrap();
        assert!(certificates.read_again(false).unwrap());
        assert_eq!(shown(), second);

        fs::write(dir.path().join("cert.pem"), "").unwrap();
        assert!(certificates.read_again(true).is_err());
        assert_eq!(shown(), second);
    }
}
