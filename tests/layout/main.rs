//! What is written about the wire is what the sources say: the C header and the wire's page are made from them and compared.
//!
//! `CAIRN_WRITE=1 cargo test --test layout` writes both anew.

mod header;
mod page;
mod support;
