//! The rules in the words of OpenAPI, for every operation, whoever wrote it.

use axum::http::Method;
use utoipa::openapi::extensions::ExtensionsBuilder;
use utoipa::openapi::path::Operation;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{ContentBuilder, OpenApi, PathItem, Ref, Response, ResponseBuilder};

use super::load::brings_work;
use super::rules::Rule;

/// Status, name and meaning of the refusals that every route with a rule may answer with.
const REFUSALS: [(&str, &str, &str); 2] = [
    ("401", "NoKey", "No key, or one that opens nothing (any more); `www-authenticate` is `Bearer`"),
    ("403", "NotAllowed", "The key may not do this"),
];

/// The same of those that bring work.
const OVERLOAD: [(&str, &str, &str); 2] = [
    ("408", "Stalled", "The body did not come in time"),
    (
        "503",
        "Overloaded",
        "No more work is taken on, or the service is stopping; `retry-after` says when to ask again",
    ),
];

/// The refusal that every route may answer with.
const TOO_MUCH: (&str, &str, &str) = (
    "429",
    "TooMuch",
    "Too many requests come from this address, or the project or the key has as much as it may; `retry-after` says when to ask again",
);

/// Writes into each operation which scope it needs (`x-cairn-scope`) and how it refuses.
pub(in crate::http) fn describe(mut api: OpenApi) -> OpenApi {
    let scheme = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .bearer_format("cairn_…")
        .description(Some("A key that `cairn key create` has made"))
        .build();
    let components = api.components.get_or_insert_default();
    components.security_schemes.insert("key".to_owned(), SecurityScheme::Http(scheme).into());
    for (_, name, meaning) in REFUSALS.into_iter().chain(OVERLOAD).chain([TOO_MUCH]) {
        components.responses.insert(name.to_owned(), problem(meaning).into());
    }
    for (template, item) in &mut api.paths.paths {
        for (method, operation) in operations(item) {
            refuse(operation, &method, &TOO_MUCH);
            match Rule::of(&method, Some(template)) {
                Rule::Open => operation.security = Some(Vec::new()),
                Rule::Key(scope, _) => {
                    let key = SecurityRequirement::new("key", Vec::<String>::new());
                    operation.security = Some(vec![key, SecurityRequirement::default()]);
                    let scope = ExtensionsBuilder::new().add("x-cairn-scope", scope.as_str()).build();
                    operation.extensions.get_or_insert_default().merge(scope);
                    let also = if brings_work(&method) { OVERLOAD.as_slice() } else { &[] };
                    REFUSALS.iter().chain(also).for_each(|refusal| refuse(operation, &method, refusal));
                }
            }
        }
    }
    api
}

/// Adds a refusal to the answers of an operation that does not describe it itself.
fn refuse(operation: &mut Operation, method: &Method, (status, name, meaning): &(&str, &str, &str)) {
    // An answer to HEAD has no body.
    let refusal = match *method {
        Method::HEAD => Response::new(*meaning).into(),
        _ => Ref::from_response_name(*name).into(),
    };
    operation.responses.responses.entry((*status).to_owned()).or_insert(refusal);
}

fn problem(meaning: &str) -> Response {
    let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
    ResponseBuilder::new().description(meaning).content("application/problem+json", content).build()
}

fn operations(item: &mut PathItem) -> impl Iterator<Item = (Method, &mut Operation)> {
    let all = [
        (Method::GET, &mut item.get),
        (Method::HEAD, &mut item.head),
        (Method::PUT, &mut item.put),
        (Method::POST, &mut item.post),
        (Method::PATCH, &mut item.patch),
        (Method::DELETE, &mut item.delete),
        (Method::OPTIONS, &mut item.options),
        (Method::TRACE, &mut item.trace),
    ];
    all.into_iter().filter_map(|(method, operation)| Some((method, operation.as_mut()?)))
}
