/** Talks to the service. Every failure becomes an Error whose message can be read to a person. */

const BUSY = 503;
const ATTEMPTS = 6;

/** The address of a path of the service, which may be mounted under a prefix. */
export function address(path, query = {}) {
  const url = new URL(path, document.baseURI);
  url.hash = '';
  for (const [key, value] of Object.entries(query)) url.searchParams.set(key, value);
  return url.href;
}

/**
 * Fetches, waiting and asking again while the service says that it is busy.
 * Throws an Error in words; an abort is passed on as it is.
 */
export async function request(url, signal) {
  for (let attempt = 1; ; attempt += 1) {
    let response;
    try {
      response = await fetch(url, { signal });
    } catch (error) {
      if (error.name === 'AbortError') throw error;
      throw new Error('The service does not answer.');
    }
    if (response.ok) return response;
    if (response.status !== BUSY || attempt === ATTEMPTS) throw new Error(await problem(response));
    await pause(1000 * (Number(response.headers.get('Retry-After')) || attempt), signal);
  }
}

export async function requestJson(url, signal) {
  const response = await request(url, signal);
  try {
    return await response.json();
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw new Error('The service sent something that is not JSON.');
  }
}

/** What went wrong, from a problem document (RFC 9457) where there is one. */
async function problem(response) {
  let document = {};
  try {
    document = await response.json();
  } catch {
    // No problem document: the status has to do.
  }
  const said = [document.detail, document.title].find((text) => typeof text === 'string' && text);
  return `${said ?? (response.statusText || 'The service refused')} (${response.status})`;
}

function pause(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    const abort = () => {
      clearTimeout(timer);
      reject(new DOMException('aborted', 'AbortError'));
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener('abort', abort);
      resolve();
    }, milliseconds);
    signal?.addEventListener('abort', abort, { once: true });
  });
}
