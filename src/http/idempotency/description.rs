//! The header in the words of OpenAPI, for every POST, whoever wrote it.

use utoipa::openapi::path::{Parameter, ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::{ObjectBuilder, SchemaType, Type};
use utoipa::openapi::{ContentBuilder, OpenApi, Ref, RefOr, Required, Response, ResponseBuilder};

use super::key::FIELD;

/// Statuses and meanings of the refusals that a key can bring about.
const REFUSALS: [(&str, &str); 2] = [
    ("409", "The first request with this idempotency key still runs"),
    ("422", "This idempotency key came before, with another request"),
];

/// Writes into each POST that it may carry a key, and how it refuses one.
pub(in crate::http) fn describe(mut api: OpenApi) -> OpenApi {
    for operation in api.paths.paths.values_mut().filter_map(|item| item.post.as_mut()) {
        if operation.parameters.iter().flatten().any(stands_for_another) {
            continue;
        }
        operation.parameters.get_or_insert_default().push(RefOr::T(header()));
        for (status, meaning) in REFUSALS {
            operation.responses.responses.entry(status.to_owned()).or_insert_with(|| problem(meaning).into());
        }
    }
    api
}

/// Whether a parameter says that the POST stands for another method.
fn stands_for_another(parameter: &RefOr<Parameter>) -> bool {
    matches!(parameter, RefOr::T(p) if p.name == "x-http-method-override")
}

fn header() -> Parameter {
    let text = ObjectBuilder::new()
        .schema_type(SchemaType::new(Type::String))
        .min_length(Some(1))
        .max_length(Some(255))
        .pattern(Some("^[!-~]+$"));
    ParameterBuilder::new()
        .name(FIELD)
        .parameter_in(ParameterIn::Header)
        .required(Required::False)
        .description(Some(
            "A name for this request, made up by the client, such as a UUID. If the request comes again with it within a day, it is \
             not done again but answered as before (`idempotency-replayed: true`)",
        ))
        .schema(Some(text))
        .build()
}

fn problem(meaning: &str) -> Response {
    let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
    ResponseBuilder::new().description(meaning).content("application/problem+json", content).build()
}
