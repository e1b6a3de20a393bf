//! Matched scenes on disk, so that fits can be tried without matching all pairs again.

use std::path::Path;

use anyhow::Context;

use crate::calibrate::MatchedScene;

/// The scene of this description from the folder, or matched now and put there. An earlier one is taken only if the program that
/// made it is byte for byte the same, since any change of the engine may change what it finds.
pub(super) fn stocked(
    folder: Option<&Path>,
    description: &str,
    matched: impl FnOnce() -> anyhow::Result<MatchedScene>,
) -> anyhow::Result<MatchedScene> {
    let Some(folder) = folder else { return matched() };
    std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    let mut key = blake3::Hasher::new();
    key.update(&program()?).update(description.as_bytes());
    let path = folder.join(format!("{}.matched", key.finalize().to_hex()));
    if path.exists() {
        let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        return postcard::from_bytes(&bytes).with_context(|| path.display().to_string());
    }
    let scene = matched()?;
    std::fs::write(&path, postcard::to_stdvec(&scene)?)
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(scene)
}

/// The bytes of the running program.
fn program() -> anyhow::Result<Vec<u8>> {
    let path = std::env::current_exe().context("cannot find the running program")?;
    std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))
}
