// Keeps every file that the page has used, so that it opens offline, and adds the headers without which a browser gives
// WebAssembly one thread only. VERSION, a digest of all files, stands above: with another, all are fetched anew.

const OURS = `mmgsd ${registration.scope} `;

addEventListener("install", () => skipWaiting());

addEventListener("activate", (event) =>
  event.waitUntil(
    (async () => {
      const names = await caches.keys();
      await Promise.all(
        names.filter((name) => name.startsWith(OURS) && name !== OURS + VERSION).map((name) => caches.delete(name)),
      );
      await clients.claim();
    })(),
  ),
);

addEventListener("fetch", (event) => {
  if (event.request.method === "GET" && event.request.url.startsWith(registration.scope))
    event.respondWith(answer(event.request));
});

async function answer(request) {
  const cache = await caches.open(OURS + VERSION);
  let response = await cache.match(request, { ignoreSearch: true, ignoreVary: true });
  if (!response) {
    response = await fetch(request.url, { cache: "no-cache" });
    if (response.status === 200) await cache.put(request.url, response.clone());
  }
  const headers = new Headers(response.headers);
  headers.set("Cross-Origin-Opener-Policy", "same-origin");
  headers.set("Cross-Origin-Embedder-Policy", "require-corp");
  headers.set("Cross-Origin-Resource-Policy", "same-origin");
  return new Response(response.body, { status: response.status, statusText: response.statusText, headers });
}
