//! `cairn openapi`: the description of the REST interface, as the code has it.

use clap::Args;

/// Print the description of the REST interface (openapi.yaml)
#[derive(Debug, Clone, Args)]
pub struct OpenapiArgs {}

/// Writes the description to standard output.
pub fn run(_: OpenapiArgs) -> anyhow::Result<()> {
    let yaml = crate::http::openapi_yaml().map_err(|problem| anyhow::anyhow!(problem.detail))?;
    print!("{yaml}");
    Ok(())
}
