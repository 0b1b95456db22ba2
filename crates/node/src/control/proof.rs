// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a token is shown where others could read it: as a proof, made for one request on one connection.
//!
//! Over plain TCP any program could have bound a node's port. So a client requests the connection's nonce first
//! ([`super::status::path::CHALLENGE`]), and sends `Authorization: Proof HEX` with its request. HEX is the secret,
//! masked with a stream that only those can make who know the secret's hash: the node, and its owner. It is made of
//! the nonce, the node's address as the client has it, the method, the path and the body. A proof is of no use at
//! another address, at another time or for another request. The node proves in its answer, with [`HEADER`], that it
//! knows the hash: the client refuses any other answer.

use super::tokens::{SecretHash, from_hex, hex};
use sha2::{Digest, Sha256};

/// The scheme of a proof in the `Authorization` header.
pub const SCHEME: &str = "Proof ";
/// The header with which the node proves that it knows the hash.
pub const HEADER: &str = "fourdbody-proof";
/// Longest secret, bytes, as `fourdbody token` reads them.
const SECRET_BYTES_MAX: usize = 256;

/// The request that a proof is for.
#[derive(Debug, Clone, Copy)]
pub struct ProvenRequest<'a> {
    /// `HOST:PORT` of the node, as in the `Host` header.
    pub authority: &'a str,
    pub nonce: &'a str,
    pub method: &'a str,
    pub path: &'a str,
    /// Empty where there is none.
    pub body: &'a [u8],
}

impl ProvenRequest<'_> {
    /// Parts hold no line breaks, and the lengths of the last two are fixed: two requests never read the same.
    fn text(&self) -> String {
        let body = SecretHash::of_bytes(self.body);
        let authority = self.authority.to_ascii_lowercase();
        format!("{}\n{authority}\n{}\n{}\n{body}", self.nonce, self.method, self.path)
    }

    /// The proof for this request, which follows [`SCHEME`] in the header.
    pub fn prove(&self, secret: &str) -> String {
        hex(&self.mask(&SecretHash::of(secret), secret.as_bytes()))
    }

    /// Whether this proof was made with the secret of this hash; the secret, then.
    pub fn secret_of(&self, proof: &str, hash: &SecretHash) -> Option<String> {
        let masked = from_hex(proof).filter(|masked| masked.len() <= SECRET_BYTES_MAX)?;
        let secret = String::from_utf8(self.mask(hash, &masked)).ok()?;
        SecretHash::of(&secret).is(hash).then_some(secret)
    }

    /// The value of [`HEADER`], by which the node proves that it knows the hash.
    pub fn answer(&self, hash: &SecretHash) -> String {
        hex(&hmac(hash.bytes(), format!("answer\n{}", self.text()).as_bytes()))
    }

    fn mask(&self, hash: &SecretHash, bytes: &[u8]) -> Vec<u8> {
        let text = self.text();
        let block = |number: usize| hmac(hash.bytes(), format!("mask {number}\n{text}").as_bytes());
        let stream = (0..).flat_map(block);
        bytes.iter().zip(stream).map(|(byte, mask)| byte ^ mask).collect()
    }
}

/// HMAC-SHA-256 (RFC 2104) with a key of 32 bytes.
fn hmac(key: &[u8; 32], message: &[u8]) -> [u8; 32] {
    const BLOCK: usize = 64;
    let mut padded = [0; BLOCK];
    padded[..key.len()].copy_from_slice(key);
    let inner = Sha256::new().chain_update(padded.map(|byte| byte ^ 0x36)).chain_update(message).finalize();
    Sha256::new().chain_update(padded.map(|byte| byte ^ 0x5c)).chain_update(inner).finalize().into()
}

#[cfg(test)]
mod tests {
    use super::{ProvenRequest, hmac};
    use crate::control::tokens::SecretHash;
    use proptest::prelude::{prop_assert_eq, proptest};

    const ASKED: ProvenRequest<'_> =
        ProvenRequest { authority: "node-b:7402", nonce: "n", method: "POST", path: "/x?y", body: b"{}" };

    #[test]
    fn it_is_the_hmac_of_the_standard() {
        // RFC 4231, test case 1; its key of 20 bytes is padded with zeros by the definition.
        let mut key = [0; 32];
        key[..20].fill(0x0b);
        let text: String = hmac(&key, b"Hi There").iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(text, "b0344c61d8db38535ca8afceaf0bf12b881dc200c9833da726e9376c2e32cff7");
    }

    proptest! {
        #[test]
        fn a_proof_is_for_one_secret_and_one_request(secret in "[a-z0-9]{32,256}", other in "[a-z0-9]{32,64}") {
            let hash = SecretHash::of(&secret);
            let proof = ASKED.prove(&secret);
            prop_assert_eq!(ASKED.secret_of(&proof, &hash), Some(secret.clone()));
            prop_assert_eq!(ASKED.secret_of(&proof, &SecretHash::of(&other)), None);
            for changed in [
                ProvenRequest { authority: "node-a:7401", ..ASKED },
                ProvenRequest { nonce: "m", ..ASKED },
                ProvenRequest { method: "GET", ..ASKED },
                ProvenRequest { path: "/x", ..ASKED },
                ProvenRequest { body: b"", ..ASKED },
            ] {
                prop_assert_eq!(changed.secret_of(&proof, &hash), None);
            }
        }

        #[test]
        fn garbage_is_no_proof(proof in ".{0,80}") {
            prop_assert_eq!(ASKED.secret_of(&proof, &SecretHash::of("secret")), None);
        }
    }
}
