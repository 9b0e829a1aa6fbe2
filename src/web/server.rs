//! Connections: bounded in number, in time, and ended in good order.

use std::future::Future;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::Request;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;
use tokio_io_timeout::TimeoutStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tower_http::timeout::TimeoutBody;

use super::access::Peer;

/// Connections at a time; more wait until one is free.
const CONNECTIONS: usize = 256;
/// For the head of a request and for TLS: a client that takes longer holds a place that others need.
const HEAD: Duration = Duration::from_secs(8);
/// Between two pieces of a body that is received.
const BODY: Duration = Duration::from_secs(10);
/// For a piece of an answer to be taken.
const TAKEN: Duration = Duration::from_secs(30);
/// How long requests under way may take to end after the stop: a client that never finishes must not hold the daemon.
const GRACE: Duration = Duration::from_secs(3);
/// After accepting failed, which happens when no file descriptor is left.
const PAUSE: Duration = Duration::from_millis(100);

/// The certificate and the private key, both PEM.
///
/// # Errors
/// Where they cannot be read or do not belong together, with the file.
pub(super) fn tls(certificate: &Path, key: &Path) -> io::Result<TlsAcceptor> {
    let wrong = |path: &Path, error: &dyn std::fmt::Display| {
        io::Error::new(
            io::ErrorKind::InvalidData,
            format!("{}: {error}; expected a file in PEM", path.display()),
        )
    };
    let chain = CertificateDer::pem_file_iter(certificate)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(|error| wrong(certificate, &error))?;
    let private = PrivateKeyDer::from_pem_file(key).map_err(|error| wrong(key, &error))?;
    let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .and_then(|builder| {
            builder
                .with_no_client_auth()
                .with_single_cert(chain, private)
        })
        .map_err(|error| wrong(certificate, &error))?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// Answers every connection with `router` until `stop` is ready; `stopping` then becomes true, and what is under way gets 3 s.
///
/// # Errors
/// Never now; the listener's failures pass by.
pub(super) async fn run(
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    router: Router,
    stopping: watch::Sender<bool>,
    stop: impl Future<Output = ()>,
) -> io::Result<()> {
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    let router = TowerToHyperService::new(router);
    let mut open = JoinSet::new();
    tokio::pin!(stop);
    loop {
        let accepted = async {
            let place = places.clone().acquire_owned().await;
            (place, listener.accept().await)
        };
        let (place, (stream, peer)) = tokio::select! {
            () = &mut stop => break,
            Some(_) = open.join_next() => continue,
            accepted = accepted => match accepted {
                (Ok(place), Ok(accepted)) => (place, accepted),
                (_, Err(error)) => {
                    tracing::warn!(%error, "a connection was not accepted");
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
                (Err(_), _) => break,
            },
        };
        let (router, tls, stopping) = (router.clone(), tls.clone(), stopping.subscribe());
        open.spawn(async move {
            greet(stream, Peer(peer), tls, router, stopping).await;
            drop(place);
        });
    }
    drop(listener);
    stopping.send_replace(true);
    let ended = tokio::time::timeout(GRACE, async { while open.join_next().await.is_some() {} });
    if ended.await.is_err() {
        tracing::info!(connections = open.len(), "connections cut off at the end");
    }
    Ok(())
}

async fn greet(
    stream: TcpStream,
    peer: Peer,
    tls: Option<TlsAcceptor>,
    router: TowerToHyperService<Router>,
    stopping: watch::Receiver<bool>,
) {
    // Small answers go out at once; where that cannot be set they go out a little later.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(TAKEN));
    let stream = Box::pin(stream);
    match tls {
        None => converse(stream, peer, router, stopping).await,
        Some(tls) => match tokio::time::timeout(HEAD, tls.accept(stream)).await {
            Ok(Ok(stream)) => converse(stream, peer, router, stopping).await,
            Ok(Err(error)) => tracing::debug!(peer = %peer.0, %error, "no TLS"),
            Err(_) => tracing::debug!(peer = %peer.0, "TLS took too long"),
        },
    }
}

async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin,
    peer: Peer,
    router: TowerToHyperService<Router>,
    mut stopping: watch::Receiver<bool>,
) {
    let service = service_fn(move |request: Request<hyper::body::Incoming>| {
        let mut request = request.map(|body| Body::new(TimeoutBody::new(BODY, body)));
        request.extensions_mut().insert(peer);
        router.call(request)
    });
    let mut builder = http1::Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(HEAD);
    let connection = builder.serve_connection(TokioIo::new(stream), service);
    tokio::pin!(connection);
    let stopped = async move {
        // An error means that the server is gone, which is a stop too.
        let _ = stopping.wait_for(|stopping| *stopping).await;
    };
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = stopped => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(peer = %peer.0, %error, "connection ended");
    }
}
