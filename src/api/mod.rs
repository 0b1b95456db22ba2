//! The node's HTTP control API: data transfer objects, server, client.
