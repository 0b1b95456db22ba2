// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody token`: who may do what on a node.

use super::failure::Failure;
use crate::base::Exit;
use crate::base::time::host_time_ns;
use crate::control::links;
use crate::control::tokens::{Role, SecretHash, Token, TokenList, random_text, token_name, write_private};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Make, renew, revoke and list the tokens of a node.
///
/// The node keeps names, roles and hashes (api.tokens in the node file); the secret lies only in the file that is given
/// to its user. A running node notices changes within a second.
#[derive(clap::Args)]
#[command(after_help = "\
Example, for the node of the service:
  sudo -u fourdbody fourdbody token new --tokens /var/lib/fourdbody/tokens --role operate --name anna --file \
/var/lib/fourdbody/anna.token
  fourdbody status --nodes https://node-a.lab:7401 --token-file anna.token
  sudo -u fourdbody fourdbody token new --tokens /var/lib/fourdbody/tokens --role operate --name anna --file \
/var/lib/fourdbody/anna.token --replace
  sudo -u fourdbody fourdbody token link --tokens /var/lib/fourdbody/tokens --name anna --url https://node-a.lab:7401
  sudo -u fourdbody fourdbody token revoke --tokens /var/lib/fourdbody/tokens --name anna")]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// Make a token: its hash goes into the node's list, the secret into a file of its own.
    New {
        /// The node's list (api.tokens); made when it is not there.
        #[arg(long, value_name = "FILE")]
        tokens: PathBuf,
        /// What its bearer may do: view, operate, admin; or peer, for another node.
        #[arg(long)]
        role: Role,
        /// The name of its user, which the audit log records.
        #[arg(long, value_parser = token_name)]
        name: String,
        /// Where the secret goes, mode 0600.
        #[arg(long, value_name = "FILE")]
        file: PathBuf,
        /// Renew: a token of this name, and the file, give way.
        #[arg(long)]
        replace: bool,
    },
    /// Print a link that logs a browser in once, without the token: for a tablet, on which nobody types 64 characters.
    Link {
        /// The node's list of tokens (api.tokens).
        #[arg(long, value_name = "FILE")]
        tokens: PathBuf,
        /// Whose login it is: a name in that list.
        #[arg(long)]
        name: String,
        /// The console's address, as the browser is to open it.
        #[arg(long, value_parser = console_address)]
        url: String,
        /// Minutes until the link expires, if nobody has used it.
        #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=60))]
        minutes: u32,
    },
    /// Take a token back: who shows it is refused, and logins with it end.
    Revoke {
        /// The node's list of tokens (api.tokens).
        #[arg(long, value_name = "FILE")]
        tokens: PathBuf,
        /// The name of the token's user.
        #[arg(long)]
        name: String,
    },
    /// Show the names and roles of all tokens.
    List {
        /// The node's list of tokens (api.tokens).
        #[arg(long, value_name = "FILE")]
        tokens: PathBuf,
        /// Print JSON instead of text.
        #[arg(long)]
        json: bool,
    },
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.action {
        Action::New { tokens, role, name, file, replace } => new(tokens, *role, name, file, *replace),
        Action::Link { tokens, name, url, minutes } => link(tokens, name, url, *minutes),
        Action::Revoke { tokens, name } => revoke(tokens, name),
        Action::List { tokens, json } => list(tokens, *json),
    }
}

fn new(path: &Path, role: Role, name: &str, file: &Path, replace: bool) -> Result<Exit, Failure> {
    let mut list = if path.exists() { TokenList::load(path)? } else { TokenList::default() };
    let known = list.0.iter().position(|token| token.name == name);
    if known.is_some() && !replace {
        let message = format!("{} has a token for {name} already; renew it with --replace", path.display());
        return Err(Failure::usage(message));
    }
    let secret =
        random_text().map_err(|e| Failure::failed(format!("the system gives no random numbers: {e}")))?;
    let token = Token { name: name.to_owned(), role, hash: SecretHash::of(&secret) };
    match known {
        Some(place) => list.0[place] = token,
        None => list.0.push(token),
    }
    // A secret that no node knows harms nobody; a node that waits for a lost secret helps nobody.
    write_private(file, &format!("{secret}\n"), replace)?;
    list.save(path)?;
    println!("{name} ({role}): the secret is in {}, its hash in {}", file.display(), path.display());
    Ok(Exit::Done)
}

/// Accepts the address of a console: what a link is appended to.
fn console_address(text: &str) -> Result<String, String> {
    let rest = text.strip_prefix("http://").or_else(|| text.strip_prefix("https://")).unwrap_or_default();
    let plain = |c: char| c.is_ascii_graphic() && !matches!(c, '#' | '?' | '@' | '\'' | '"' | '<' | '>');
    if !rest.is_empty() && !rest.starts_with('/') && rest.chars().all(plain) {
        return Ok(text.trim_end_matches('/').to_owned());
    }
    Err(format!("expected the console's address such as https://node-a.lab:7401, found {text:?}"))
}

fn link(path: &Path, name: &str, url: &str, minutes: u32) -> Result<Exit, Failure> {
    let list = TokenList::load(path)?;
    let token = list.0.iter().find(|token| token.name == name).ok_or_else(|| no_token(path, &list, name))?;
    if token.role == Role::Peer {
        let message = format!("{name} is another node (role peer); expected a person, who uses a browser");
        return Err(Failure::usage(message));
    }
    let lifetime = Duration::from_secs(u64::from(minutes) * 60);
    let code = links::issue(path, token, lifetime, host_time_ns())?;
    println!("{url}/#login={code}");
    eprintln!("logs {name} ({}) in once, within {minutes} minutes; give it to nobody else", token.role);
    Ok(Exit::Done)
}

fn no_token(path: &Path, list: &TokenList, name: &str) -> Failure {
    let names: Vec<&str> = list.0.iter().map(|token| token.name.as_str()).collect();
    Failure::usage(format!("{} has no token for {name}; it has: {}", path.display(), names.join(", ")))
}

fn revoke(path: &Path, name: &str) -> Result<Exit, Failure> {
    let mut list = TokenList::load(path)?;
    if list.0.iter().all(|token| token.name != name) {
        return Err(no_token(path, &list, name));
    }
    list.0.retain(|token| token.name != name);
    list.save(path)?;
    println!("{name}: revoked");
    Ok(Exit::Done)
}

fn list(path: &Path, json: bool) -> Result<Exit, Failure> {
    let list = TokenList::load(path)?;
    if json {
        let tokens: Vec<_> = list
            .0
            .iter()
            .map(|token| serde_json::json!({ "name": token.name, "role": token.role }))
            .collect();
        println!("{}", serde_json::json!({ "tokens": tokens }));
    } else {
        list.0.iter().for_each(|token| println!("{} {}", token.name, token.role));
    }
    Ok(Exit::Done)
}
