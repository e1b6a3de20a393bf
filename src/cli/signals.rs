//! What Ctrl-C and SIGTERM do to a running command. Used by every command that runs long.

use crate::control::CancelToken;

/// Exit code of a command that was told to stop, as shells have it for SIGINT.
pub(super) const INTERRUPTED: u8 = 130;

/// Returns at the next SIGINT or SIGTERM.
pub(super) async fn signal() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        tracing::error!("SIGTERM cannot be listened for");
        return std::future::pending().await;
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        _ = terminate.recv() => {}
    }
}

/// A token that the first signal cancels; the second ends the process at once.
pub(super) fn cancelled_by_signal() -> anyhow::Result<CancelToken> {
    let token = CancelToken::new();
    let cancel = token.clone();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        runtime.block_on(async {
            signal().await;
            cancel.cancel();
            signal().await;
            std::process::exit(INTERRUPTED.into());
        });
    })?;
    Ok(token)
}
