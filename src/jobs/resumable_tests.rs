//! Resumable uploads against a model of what they should do: random requests, broken connections and restarts; and the
//! moments between two steps at which a process may die.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;
use futures_util::stream;
use proptest::prelude::*;
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;

use super::{
    Continuation, DigestAlgorithm, ExpectedDigest, Intake, IntakeError, IntakeLimits, Resumable,
    ResumableError,
};
use crate::project::{Interpretation, Name, NewUpload, ProjectId, ProjectSettings, UploadId};
use crate::storage::{Page, Seal, StorageError, Store};

const LIMIT: u64 = 3000;

/// A service on a directory, with one project.
struct Service {
    store: Store,
    uploads: Resumable,
    project: ProjectId,
    dir: TempDir,
}

impl Service {
    async fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let name = Name::parse("test").unwrap();
        let project =
            store.create_project(&name, &ProjectSettings::default(), Seal::none()).await.unwrap().id;
        Self { uploads: resumable(&store), store, project, dir }
    }

    async fn restart(self) -> Self {
        let Self { store, uploads, project, dir } = self;
        store.close().await;
        drop((store, uploads));
        let store = Store::open(dir.path()).await.unwrap();
        Self { uploads: resumable(&store), store, project, dir }
    }

    async fn create(&self, length: u64) -> Result<UploadId, ResumableError> {
        let new = NewUpload {
            project: self.project,
            name: Name::parse("a.xyz").unwrap(),
            interpretation: Interpretation::default(),
            metadata: String::new(),
            length,
            sender: None,
        };
        self.uploads.create(new, Seal::none()).await.map(|upload| upload.id)
    }

    async fn scans(&self) -> usize {
        self.store.scans(self.project, Page { after: None, limit: 100 }).await.unwrap().len()
    }
}

fn resumable(store: &Store) -> Resumable {
    lasting(store, Duration::from_hours(1))
}

/// Uploads that expire after this time.
fn lasting(store: &Store, lifetime: Duration) -> Resumable {
    let limits = IntakeLimits { max_bytes: LIMIT, idle: Duration::from_secs(5), free_bytes: 0 };
    let intake = Intake::new(store.clone(), limits);
    Resumable::new(store.clone(), intake, lifetime, CancellationToken::new())
}

/// Points as text; the same length from the same source is the same content.
fn content(source: u8, length: usize) -> Vec<u8> {
    let rows: Vec<String> = (0..200).map(|i| format!("{i} {source} 0.{i}\n")).collect();
    rows.concat().into_bytes()[..length].to_vec()
}

fn body(
    bytes: &[u8],
    piece: usize,
    breaks: bool,
) -> impl futures_util::Stream<Item = Result<Bytes, &'static str>> + Send + use<> {
    let pieces: Vec<_> = bytes.chunks(piece).map(|p| Ok(Bytes::copy_from_slice(p))).collect();
    let end = if breaks { vec![Err("connection reset")] } else { Vec::new() };
    stream::iter(pieces.into_iter().chain(end))
}

fn plain(offset: u64) -> Continuation {
    Continuation { offset, declared: None, digests: Vec::new() }
}

/// Whether a request says what its bytes hash to.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Checksum {
    None,
    Right,
    Wrong,
}

#[derive(Debug, Clone)]
enum Action {
    Create {
        source: u8,
        length: usize,
    },
    Patch {
        which: usize,
        shift: i64,
        length: usize,
        declared: bool,
        checksum: Checksum,
        breaks: bool,
        piece: usize,
    },
    Resume {
        which: usize,
    },
    Terminate {
        which: usize,
    },
    Restart,
}

fn action() -> impl Strategy<Value = Action> {
    let checksum =
        prop_oneof![4 => Just(Checksum::None), 1 => Just(Checksum::Right), 1 => Just(Checksum::Wrong)];
    let shift = prop_oneof![8 => Just(0i64), 1 => -3..4i64];
    let length = prop_oneof![3 => 0..700usize, 1 => Just(usize::MAX)];
    prop_oneof![
        2 => (0..2u8, prop_oneof![Just(600), Just(900), 1..1000usize, Just(4000)])
            .prop_map(|(source, length)| Action::Create { source, length }),
        8 => (0..4usize, shift, length, any::<bool>(), checksum, prop::bool::weighted(0.2), 1..400usize).prop_map(
            |(which, shift, length, declared, checksum, breaks, piece)| Action::Patch {
                which, shift, length, declared, checksum, breaks, piece
            }
        ),
        1 => (0..4usize).prop_map(|which| Action::Resume { which }),
        1 => (0..4usize).prop_map(|which| Action::Terminate { which }),
        1 => Just(Action::Restart),
    ]
}

/// What an upload should be.
#[derive(Debug)]
struct Modelled {
    id: UploadId,
    content: Vec<u8>,
    received: usize,
    gone: bool,
}

/// What a request that continues an upload should come to.
#[derive(Debug, PartialEq)]
enum Expected {
    Kept(usize),
    Broken(usize),
    Offset,
    PastEnd,
    Mismatch,
    Gone,
}

struct Request {
    offset: i64,
    length: usize,
    declared: bool,
    checksum: Checksum,
    breaks: bool,
}

fn expected(upload: &Modelled, r: &Request) -> Expected {
    let whole = upload.received + r.length == upload.content.len();
    if upload.gone {
        Expected::Gone
    } else if r.offset != upload.received as i64 {
        Expected::Offset
    } else if upload.received + r.length > upload.content.len() {
        Expected::PastEnd
    } else if upload.received == upload.content.len() {
        Expected::Kept(0)
    } else if r.breaks && !whole {
        Expected::Broken(if r.checksum == Checksum::None { r.length } else { 0 })
    } else if r.checksum == Checksum::Wrong {
        Expected::Mismatch
    } else {
        Expected::Kept(r.length)
    }
}

async fn perform(service: &Service, uploads: &mut [Modelled], done: &mut BTreeSet<Vec<u8>>, action: &Action) {
    let Action::Patch { which, shift, length, declared, checksum, breaks, piece } = action else { return };
    let Some(upload) = uploads.get_mut(*which) else { return };
    // The rest, or as many bytes as asked for; past the end there is more of the same.
    let missing = upload.content.len() - upload.received;
    let length = if *length == usize::MAX { missing } else { *length };
    let bytes: Vec<u8> = upload
        .content
        .iter()
        .copied()
        .chain(std::iter::repeat(b'0'))
        .skip(upload.received)
        .take(length)
        .collect();
    let offset = (upload.received as i64 + shift).max(0);
    let request = Request { offset, length, declared: *declared, checksum: *checksum, breaks: *breaks };
    let digest = match checksum {
        Checksum::None => None,
        Checksum::Right => Some(Sha256::digest(&bytes).to_vec()),
        Checksum::Wrong => Some(vec![7; 32]),
    };
    let continuation = Continuation {
        offset: offset as u64,
        declared: request.declared.then_some(length as u64),
        digests: digest
            .into_iter()
            .map(|value| ExpectedDigest { algorithm: DigestAlgorithm::Sha256, value })
            .collect(),
    };
    let answer = service.uploads.append(upload.id, continuation, body(&bytes, *piece, *breaks)).await;
    let expected = expected(upload, &request);
    match (&answer, &expected) {
        (Ok(found), Expected::Kept(more)) => {
            upload.received += more;
            assert_eq!(found.received as usize, upload.received);
            let whole = upload.received == upload.content.len();
            assert_eq!(found.end.is_some(), whole);
            if let Some(end) = found.end
                && *more > 0
            {
                assert_eq!(end.duplicate, !done.insert(upload.content.clone()));
                let scan = service.store.scan(service.project, end.scan).await.unwrap();
                assert_eq!(scan.blob, blake3::hash(&upload.content).to_hex().as_str());
            }
        }
        (Err(ResumableError::Intake(IntakeError::Interrupted { .. })), Expected::Broken(more)) => {
            upload.received += more;
        }
        (Err(ResumableError::Offset { .. }), Expected::Offset)
        | (Err(ResumableError::PastEnd { .. }), Expected::PastEnd)
        | (Err(ResumableError::Digest(_)), Expected::Mismatch)
        | (Err(ResumableError::Intake(IntakeError::Storage(StorageError::NoUpload(_)))), Expected::Gone) => {}
        _ => panic!("{expected:?} was expected, but {answer:?} came of {action:?} on {upload:?}"),
    }
}

async fn play(actions: Vec<Action>) {
    let mut service = Service::new().await;
    let mut uploads: Vec<Modelled> = Vec::new();
    // Contents that have become scans.
    let mut done = BTreeSet::new();
    for action in actions {
        match &action {
            Action::Create { source, length } => match service.create(*length as u64).await {
                Ok(id) => {
                    uploads.push(Modelled {
                        id,
                        content: content(*source, *length),
                        received: 0,
                        gone: false,
                    });
                }
                Err(ResumableError::Intake(IntakeError::TooLarge { limit })) => {
                    assert!(*length as u64 > limit && limit == LIMIT);
                }
                Err(error) => panic!("{error}"),
            },
            Action::Patch { .. } => perform(&service, &mut uploads, &mut done, &action).await,
            Action::Resume { which } => {
                if let Some(upload) = uploads.get(*which) {
                    let found = service.uploads.resume(upload.id).await;
                    assert_eq!(found.is_err(), upload.gone);
                }
            }
            Action::Terminate { which } => {
                if let Some(upload) = uploads.get_mut(*which) {
                    assert_eq!(service.uploads.terminate(upload.id).await.is_err(), upload.gone);
                    upload.gone = true;
                }
            }
            Action::Restart => service = service.restart().await,
        }
        for upload in &uploads {
            match service.uploads.peek(upload.id).await {
                Ok(found) => assert_eq!((found.received as usize, false), (upload.received, upload.gone)),
                Err(_) => assert!(upload.gone),
            }
        }
        assert_eq!(service.scans().await, done.len());
    }
    service.store.close().await;
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn whatever_clients_send_uploads_are_where_the_model_says(
        actions in prop::collection::vec(action(), 1..30)
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(play(actions));
    }
}

#[tokio::test]
async fn a_death_between_the_blob_and_its_scan_loses_nothing() {
    let service = Service::new().await;
    let bytes = content(0, 900);
    let id = service.create(900).await.unwrap();
    service.uploads.append(id, plain(0), body(&bytes[..500], 100, false)).await.unwrap();
    // What the last request does before it acknowledges the scan.
    let mut file = service.store.uploads.at(id, 500).await.unwrap();
    file.write(&bytes[500..]).await.unwrap();
    file.sync().await.unwrap();
    let stored = service.store.uploads.hash(id).await.unwrap();
    drop(service.store.settle_upload(id, stored).await.unwrap());
    let service = service.restart().await;
    service.store.collect_garbage(Duration::ZERO).await.unwrap();
    assert_eq!(
        service.uploads.peek(id).await.unwrap().received,
        500,
        "nothing says yet that the rest is there"
    );
    let found = service.uploads.resume(id).await.unwrap();
    assert_eq!((found.received, found.end.map(|end| end.duplicate)), (900, Some(false)));
    assert_eq!(service.scans().await, 1);
    assert_eq!(service.store.blobs.get(stored.id).unwrap(), bytes);
    service.store.close().await;
}

#[tokio::test]
async fn bytes_that_no_row_vouches_for_are_cut_off() {
    let service = Service::new().await;
    let bytes = content(0, 900);
    let id = service.create(900).await.unwrap();
    service.uploads.append(id, plain(0), body(&bytes[..500], 100, false)).await.unwrap();
    let mut file = service.store.uploads.at(id, 500).await.unwrap();
    file.write(&[0; 300]).await.unwrap();
    file.sync().await.unwrap();
    let service = service.restart().await;
    let found = service.uploads.append(id, plain(500), body(&bytes[500..], 100, false)).await.unwrap();
    assert!(found.end.is_some());
    assert_eq!(found.blob.as_deref(), Some(blake3::hash(&bytes).to_hex().as_str()));
    service.store.close().await;
}

#[tokio::test]
async fn an_upload_that_lost_its_bytes_says_so() {
    let service = Service::new().await;
    let id = service.create(900).await.unwrap();
    service.uploads.append(id, plain(0), body(&content(0, 500), 100, false)).await.unwrap();
    std::fs::remove_file(service.dir.path().join("uploads").join(id.to_string())).unwrap();
    let answer = service.uploads.append(id, plain(500), body(&content(0, 100), 100, false)).await;
    let lost = StorageError::DamagedUpload { upload: id, kept: 500, found: 0 };
    assert_eq!(answer.unwrap_err().to_string(), lost.to_string());
    service.store.close().await;
}

#[tokio::test]
async fn an_upload_does_not_expire_while_its_bytes_come_even_if_all_are_kept_or_none() {
    let mut service = Service::new().await;
    let lifetime = Duration::from_secs(2);
    service.uploads = lasting(&service.store, lifetime);
    let bytes = content(0, 900);
    let id = service.create(900).await.unwrap();
    let store = service.store.clone();
    let pieces: Vec<_> = bytes.chunks(180).map(Bytes::copy_from_slice).collect();
    let slow = stream::unfold((pieces.into_iter(), store), move |(mut pieces, store)| async move {
        let piece = pieces.next()?;
        tokio::time::sleep(lifetime / 3).await;
        store.collect_garbage(Duration::ZERO).await.unwrap();
        Some((Ok::<_, &str>(piece), (pieces, store)))
    });
    let sha = ExpectedDigest { algorithm: DigestAlgorithm::Sha256, value: Sha256::digest(&bytes).to_vec() };
    let request = Continuation { digests: vec![sha], ..plain(0) };
    let done = service.uploads.append(id, request, Box::pin(slow)).await.unwrap();
    assert!(done.end.is_some());
    assert_eq!(service.scans().await, 1);
    service.store.close().await;
}
