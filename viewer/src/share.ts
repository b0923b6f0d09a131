/** The button that shares the view: by the system's dialog if there is one, else by copying the URL. */

import { writeAddress } from './address';
import { byId } from './dom';
import type { Store } from './state';

const SAID_MS = 4000;
const SIGN = '<path d="M10 12.5v-9M6.5 6.5 10 3l3.5 3.5M5.5 9H4.2v8h11.6V9h-1.3"/>';

export interface Shared {
  readonly title: string;
  readonly url: string;
}

/** What a browser has for sharing; parts are missing without HTTPS. */
export interface Sharing {
  share?(shared: Shared): Promise<void>;
  readonly clipboard?: { writeText(text: string): Promise<void> };
}

export type Outcome = 'shared' | 'copied' | 'cancelled' | 'failed';

/** Shares by the system's dialog, else copies the address. */
export async function share(shared: Shared, sharing: Sharing): Promise<Outcome> {
  if (sharing.share) {
    try {
      await sharing.share(shared);
      return 'shared';
    } catch (error) {
      if (error instanceof Error && error.name === 'AbortError') return 'cancelled';
      // The system has nothing to share with: the address is copied instead.
    }
  }
  try {
    if (!sharing.clipboard) return 'failed';
    await sharing.clipboard.writeText(shared.url);
    return 'copied';
  } catch {
    return 'failed';
  }
}

const WORDS: Record<Outcome, string> = {
  shared: 'The address is shared.',
  copied: 'The address is copied. It shows what you see.',
  cancelled: '',
  failed: 'The browser lets nothing be copied here. Copy the address from its own bar.',
};

/** Makes the button. What it did is said in a line over the map, and to screen readers. */
export function makeShare(store: Store, announce: (words: string) => void): void {
  const button = byId<HTMLButtonElement>('share');
  button.innerHTML = `<svg viewBox="0 0 20 20" width="20" height="20" aria-hidden="true">${SIGN}</svg>`;
  button.setAttribute('aria-label', 'Share what is seen');
  button.title = 'Share what is seen';
  const line = byId('shared');
  let timer: ReturnType<typeof setTimeout> | undefined;
  button.addEventListener('click', async () => {
    // The page's own address follows the state a moment later.
    const url = new URL(writeAddress(store.state), location.href).href;
    const words = WORDS[await share({ title: document.title, url }, navigator)];
    clearTimeout(timer);
    line.querySelector('p')?.replaceChildren(words);
    line.hidden = words === '';
    announce(words);
    timer = setTimeout(() => { line.hidden = true; }, SAID_MS);
  });
}
