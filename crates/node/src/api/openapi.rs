// SPDX-License-Identifier: MIT OR Apache-2.0
//! The description of the API (OpenAPI), made from the code of its routes.

use crate::base::Fault;
use crate::control::status::path;
use utoipa::OpenApi as _;
use utoipa::openapi::security::{
    ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityRequirement, SecurityScheme,
};
use utoipa::openapi::{Components, Content, OpenApi, Ref, RefOr, ResponseBuilder};

#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "fourdbody node",
        description = "Control of one acquisition PC: health, devices, settings, sessions, metrics. Every change is \
            written into an audit log. Durations are in microseconds unless a name states another unit.",
        license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0"),
    ),
    components(schemas(Fault))
)]
struct Base;

/// What the description begins with, before any route.
pub(super) fn base() -> OpenApi {
    Base::openapi()
}

/// What holds for every route: how to authenticate, and the answers of the layers before it.
pub(super) fn complete(mut api: OpenApi) -> OpenApi {
    let components = api.components.get_or_insert_with(Components::new);
    let token = Http::new(HttpAuthScheme::Bearer);
    components.add_security_scheme("token", SecurityScheme::Http(token));
    let cookie = ApiKeyValue::with_description("fourdbody_NODE", "Set by a login; for browsers.");
    components.add_security_scheme("cookie", SecurityScheme::ApiKey(ApiKey::Cookie(cookie)));
    let none: [&str; 0] = [];
    api.security =
        Some(vec![SecurityRequirement::new("token", none), SecurityRequirement::new("cookie", none)]);
    for (name, item) in &mut api.paths.paths {
        let looks = item.get.iter_mut().map(|operation| (operation, false));
        let changes = [&mut item.post, &mut item.put, &mut item.patch, &mut item.delete];
        let changes =
            changes.into_iter().flat_map(|operation| operation.iter_mut()).map(|operation| (operation, true));
        for (operation, changes) in looks.chain(changes) {
            let everywhere = [
                ("401", "No valid token was shown."),
                ("403", "The role does not suffice, or another site's page asks."),
                ("421", "The Host is not this node."),
                ("429", "Too many requests."),
            ];
            let with_body = [
                ("400", "The body is not what is described."),
                ("408", "The body did not come in time."),
                ("413", "The body is too large."),
                ("415", "The body is not `application/json`."),
            ];
            let also = with_body.iter().filter(|_| changes);
            for (status, description) in everywhere.iter().chain(also) {
                let responses = &mut operation.responses.responses;
                responses.entry((*status).to_owned()).or_insert_with(|| fault(description).into());
            }
            for (_, response) in
                operation.responses.responses.iter_mut().filter(|(status, _)| is_error(status))
            {
                if let RefOr::T(response) = response
                    && response.content.is_empty()
                {
                    response.content.insert("application/json".to_owned(), fault_content().into());
                }
            }
            if [path::LOGIN, path::LOGIN_BY_LINK, path::CHALLENGE, path::FITNESS].contains(&name.as_str()) {
                operation.security = Some(Vec::new());
            }
        }
    }
    api
}

fn fault(description: &str) -> utoipa::openapi::Response {
    ResponseBuilder::new().description(description).build()
}

fn fault_content() -> Content {
    Content::new(Some(Ref::from_schema_name("Fault")))
}

fn is_error(status: &str) -> bool {
    status.starts_with(['4', '5'])
}
