//! The REST interface, tried from outside: a real server on a real database, over real HTTP.

mod access;
mod bad_files;
mod decisions;
mod description;
mod downloads;
mod encrypted;
mod idempotency;
mod jobs;
mod key_command;
mod lifecycle;
mod limits;
mod metrics;
mod rates;
mod restore;
#[path = "../shared/room.rs"]
mod room;
mod server;
mod tus;
mod tus_clients;
mod uploads;
mod webhooks;
