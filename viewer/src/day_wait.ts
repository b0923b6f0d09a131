/** Message while the played day waits for a picture: nothing at first, then the progress and a button that stops it. */

import { clockText } from './moments';
import type { DayWait } from './player';
import type { Note } from './status';

const AFTER_MS = 700;
/** Words that went as soon as a picture comes could not be read. */
const STAYS_MS = 1500;

export function waitText({ minutes, tiles, ready, all }: DayWait): Note {
  const parts = [tiles && tiles.all > 1 && `${tiles.done} of ${tiles.all} tiles`, `${ready} of ${all} pictures of the day`];
  return { words: `Drawing ${clockText(minutes)}`, count: parts.filter(Boolean).join(', '), quiet: false };
}

export class DayWaitLine {
  #since: number | null = null;
  #isShown = false;
  #timer: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly show: (note: Note | null) => void) {}

  /** Hears what is waited for, again and again while that lasts; null: nothing. */
  see(wait: DayWait | null): void {
    clearTimeout(this.#timer);
    if (!wait) {
      this.#since = null;
      if (this.#isShown) this.#timer = setTimeout(() => this.end(), STAYS_MS);
      return;
    }
    this.#since ??= performance.now();
    if (!this.#isShown && performance.now() - this.#since < AFTER_MS) return;
    this.#isShown = true;
    this.show(waitText(wait));
  }

  end(): void {
    clearTimeout(this.#timer);
    this.#since = null;
    if (this.#isShown) this.show(null);
    this.#isShown = false;
  }
}
