//! Files that are not what they claim: each gets a clear answer, and nobody else notices.

use serde_json::Value;

use crate::server::{Server, problem, room};

/// What must become of a file.
enum Fate {
    /// Refused at once, with this status and kind of problem.
    Refused(u16, &'static str),
    /// Taken in; its job fails with this code.
    JobFails(&'static str),
}
use Fate::{JobFails, Refused};

const UNREADABLE: Fate = JobFails("unreadable-scan");

fn ply(vertices: &str, format: &str, body: &[u8]) -> Vec<u8> {
    let mut file = format!(
        "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    .into_bytes();
    file.extend(body);
    file
}

fn corrupt_lzf() -> Vec<u8> {
    let mut file = b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 500\nHEIGHT 1\n\
        VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 500\nDATA binary_compressed\n"
        .to_vec();
    file.extend(400_u32.to_le_bytes());
    file.extend(6000_u32.to_le_bytes());
    file.extend([0xff; 400]);
    file
}

/// What is wrong, the query, the bytes, and what must become of them.
fn bad_files() -> Vec<(&'static str, &'static str, Vec<u8>, Fate)> {
    let whole = room(0.0);
    let (little, ascii) = ("binary_little_endian", "ascii");
    let png = [b"\x89PNG\r\n\x1a\n".as_slice(), &[7; 3000]].concat();
    vec![
        ("truncated", "name=a.ply", whole[..whole.len() / 2].to_vec(), UNREADABLE),
        ("lying header", "name=b.ply", ply("1000", little, &[0x3f; 12 * 400]), UNREADABLE),
        ("wrong type", "name=c.ply", png, Refused(415, "unknown-format")),
        ("empty", "name=d.ply", Vec::new(), Refused(422, "empty-upload")),
        ("only NaN", "name=e.ply", ply("300", ascii, "nan nan nan\n".repeat(300).as_bytes()), UNREADABLE),
        ("huge count", "name=f.ply", ply("1000000000000000000", little, &[0; 1200]), UNREADABLE),
        ("text for binary", "name=g.ply", ply("300", little, "1 2 3\n".repeat(40).as_bytes()), UNREADABLE),
        ("corrupt LZF", "name=h.pcd", corrupt_lzf(), UNREADABLE),
        ("wrong extension", "name=i.pcd", room(0.5), Refused(422, "wrong-extension")),
        ("non-UTF-8 name", "name=j%FF%FE.ply", room(0.6), Refused(400, "invalid-field")),
        ("too few points", "name=k.ply", ply("3", ascii, b"0 0 0\n1 0 0\n0 1 0\n"), JobFails("unfit-scan")),
    ]
}

#[tokio::test(flavor = "multi_thread")]
async fn each_bad_file_gets_a_clear_answer_and_good_ones_are_registered_all_the_same() {
    let server = Server::start().await;
    let project = server.project().await;
    let good = server.accepted(&project, "good.ply", room(0.0)).await;
    let mut failing = Vec::new();
    for (what, query, bytes, fate) in bad_files() {
        let answer = server.upload(&project, query, bytes).await;
        match fate {
            Refused(status, word) => {
                let body = problem(answer, status, word).await;
                assert!(body["detail"].as_str().unwrap().len() > 10, "{what}: {body}");
            }
            JobFails(code) => {
                assert_eq!(answer.status(), 202, "{what}");
                failing.push((what, code, answer.json::<Value>().await.unwrap()));
            }
        }
    }
    let later = server.accepted(&project, "later.ply", room(0.3)).await;
    for (what, code, answer) in failing {
        let job = server.ended(&answer["job"]).await;
        assert_eq!(job["status"], "failed", "{what}: {job}");
        assert_eq!(job["problem"]["type"], format!("urn:cairn:problem:{code}"), "{what}: {job}");
        assert!(job["problem"]["detail"].as_str().unwrap().len() > 20, "{what}: {job}");
        let path = format!("{project}/scans/{}", answer["scan"]["id"].as_str().unwrap());
        let scan = server.json(&path).await;
        assert_eq!(
            (&scan["state"], &scan["outcome"]["problem"]),
            (&"failed".into(), &job["problem"]),
            "{what}"
        );
    }
    for answer in [good, later] {
        let job = server.ended(&answer["job"]).await;
        assert_eq!(job["status"], "succeeded", "{job}");
    }
    assert_eq!(server.get("/readyz").await.status(), 200);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_whose_upload_is_refused_unread_is_told_to_open_another_connection() {
    let server = Server::start().await;
    let project = server.project().await;
    let refused = server.upload(&project, "name=j%FF%FE.ply", room(0.6)).await;
    assert_eq!(
        (refused.status().as_u16(), &refused.headers()["connection"]),
        (400, &"close".parse().unwrap())
    );
    let taken = server.upload(&project, "name=good.ply", room(0.6)).await;
    assert!(taken.status() == 202 && !taken.headers().contains_key("connection"));
}
