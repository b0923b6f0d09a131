/** The page's state as the part of its address after "#", so that a view can be bookmarked and sent. */

export function readHash() {
  const state = {};
  for (const part of location.hash.slice(1).split('&')) {
    const [key, value = ''] = part.split('=');
    try {
      if (key) state[key] = decodeURIComponent(value);
    } catch {
      // A half escape in a hand-written address: the part is left out, the rest counts.
    }
  }
  return state;
}

export function writeHash(state) {
  const parts = Object.entries(state)
    .filter(([, value]) => value !== undefined && value !== null)
    // ":", "/" and "," mean nothing in a fragment; left bare, the address stays readable. "+" stays escaped.
    .map(([key, value]) => `${key}=${encodeURIComponent(value).replace(/%(3A|2F|2C)/g, decodeURIComponent)}`);
  history.replaceState(null, '', `#${parts.join('&')}`);
}
