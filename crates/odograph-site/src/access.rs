//! Who may do what at a site: whoever has the token of the site, and robots with their own.

use crate::refusals::{Refusal, RefusalKind};
use crate::tokens::{CurrentTokens, Owner};
use odograph::error::Error;
use odograph_live::server::access::{Access, AccessVerdict, same, same_origin};
use odograph_live::server::http::{Answer, Method, Request};
use serde_json::json;
use std::path::Path;

/// Who sends a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Caller {
    /// Whoever has the token of the site, or is on this machine where there is none.
    Operator {
        /// Whether the answer moves the token from the URL into a cookie.
        sets_cookie: bool,
    },
    /// A robot with a token of its own.
    Robot(String),
}

/// A request that is not answered, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Denial {
    pub status: u16,
    pub phrase: &'static str,
    pub refusal: Refusal,
}

impl Denial {
    fn forbidden(kind: RefusalKind, robot: Option<&str>, reason: impl Into<String>) -> Self {
        let refusal = Refusal { kind, robot: robot.map(str::to_owned), reason: reason.into() };
        Self { status: 403, phrase: "Forbidden", refusal }
    }

    /// There are too many requests of a robot; they may come again.
    pub fn flood(robot: &str, reason: String) -> Self {
        let refusal = Refusal { kind: RefusalKind::Flood, robot: Some(robot.to_owned()), reason };
        Self { status: 429, phrase: "Too Many Requests", refusal }
    }

    /// The body is longer than any.
    pub fn too_large(robot: Option<&str>, most: usize) -> Self {
        let robot = robot.map(str::to_owned);
        let reason = format!("the request is longer than {most} bytes");
        Self {
            status: 413,
            phrase: "Content Too Large",
            refusal: Refusal { kind: RefusalKind::Content, robot, reason },
        }
    }

    /// The answer to the request.
    pub fn answer(&self, request: &Request) -> Answer {
        let (status, phrase, reason) = (self.status, self.phrase, &self.refusal.reason);
        let answer = match request.method {
            Method::Post => Answer::ok("application/json", json!({ "problem": reason }).to_string()),
            Method::Get | Method::Head => {
                Answer::ok("text/plain; charset=utf-8", format!("{phrase}: {reason}\n"))
            }
        };
        let answer = Answer { status, reason: phrase, ..answer };
        if status == 429 { answer.with("Retry-After", "1") } else { answer }
    }
}

/// Access to a site.
#[derive(Debug)]
pub struct SiteAccess {
    of_site: Access,
    token: Option<String>,
    tokens: CurrentTokens,
}

impl SiteAccess {
    /// With the token of the site, if there is one, and those of the robots in its folder.
    pub fn new(folder: &Path, token: Option<String>) -> Self {
        Self { of_site: Access::new(token.clone()), token, tokens: CurrentTokens::in_folder(folder) }
    }

    /// The value of the `Set-Cookie` header that stores the token of the site.
    pub fn cookie(&self, is_encrypted: bool) -> String {
        self.of_site.cookie() + if is_encrypted { "; Secure" } else { "" }
    }

    /// Decides who sends a request. Fails if that is nobody known.
    pub fn caller(&self, request: &Request) -> Result<Caller, Denial> {
        if !same_origin(request) {
            return Err(Denial::forbidden(
                RefusalKind::Origin,
                None,
                "the request is of a page of another site",
            ));
        }
        let unknown =
            || Denial::forbidden(RefusalKind::UnknownToken, None, "the token is not valid at this site");
        if let Some(given) = request.bearer() {
            if self.token.as_ref().is_some_and(|token| same(given.as_bytes(), token.as_bytes())) {
                return Ok(Caller::Operator { sets_cookie: false });
            }
            return match self.tokens.now().map_err(|error| unreadable(&error))?.owner(given) {
                Some(Owner::Robot(robot)) => Ok(Caller::Robot(robot)),
                Some(Owner::Revoked(robot)) => Err(Denial::forbidden(
                    RefusalKind::Revoked,
                    Some(&robot),
                    format!(
                        "the token of robot {robot} is revoked; a new one is made by odograph site token add on the \
                         machine of the site"
                    ),
                )),
                None => Err(unknown()),
            };
        }
        match self.of_site.judge(request) {
            AccessVerdict::Allowed => Ok(Caller::Operator { sets_cookie: false }),
            AccessVerdict::AllowedWithCookie => Ok(Caller::Operator { sets_cookie: true }),
            AccessVerdict::Denied if request.query_value("token").is_some() => Err(unknown()),
            AccessVerdict::Denied => {
                Err(Denial::forbidden(RefusalKind::NoToken, None, "the request has no token"))
            }
        }
    }

    /// Whether somebody may send records as a robot: the robot itself, and whoever has the token of
    /// the site as long as the robot has none of its own.
    pub fn check_sender(&self, caller: &Caller, robot: &str) -> Result<(), Denial> {
        match caller {
            Caller::Robot(own) if own == robot => Ok(()),
            Caller::Robot(own) => {
                // The other name is as the robot gave it: only that of the token is a known one.
                Err(Denial::forbidden(
                    RefusalKind::Forbidden,
                    Some(own),
                    format!("the token is that of robot {own}, which sends as another robot"),
                ))
            }
            Caller::Operator { .. } => {
                match self.tokens.now().map_err(|error| unreadable(&error))?.has(robot) {
                    false => Ok(()),
                    true => Err(Denial::forbidden(
                        RefusalKind::Forbidden,
                        Some(robot),
                        format!("robot {robot} has a token of its own and sends with that alone"),
                    )),
                }
            }
        }
    }

    /// Whether somebody may see the page and decide about robots.
    pub fn check_operator(&self, caller: &Caller) -> Result<(), Denial> {
        match caller {
            Caller::Operator { .. } => Ok(()),
            Caller::Robot(robot) => Err(Denial::forbidden(
                RefusalKind::Forbidden,
                Some(robot),
                format!(
                    "the token of robot {robot} is for its records only; the page needs that of the site"
                ),
            )),
        }
    }
}

/// The robots' tokens cannot be read: nobody sends until they can.
fn unreadable(error: &Error) -> Denial {
    let refusal = Refusal { kind: RefusalKind::Unreadable, robot: None, reason: error.to_string() };
    Denial { status: 503, phrase: "Service Unavailable", refusal }
}
