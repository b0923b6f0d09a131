/** What the page says of its work: a line that runs while tiles are on their way, words where that takes long, and failures. */

import { byId } from './dom';
import type { Progress } from './tiles';

/** After so long somebody wonders. */
const SLOW_MS = 5000;
const SHOWN_AFTER_MS = 250;

export class Status {
  readonly #box = byId('status');
  readonly #words = byId('status-words');
  readonly #again = byId<HTMLButtonElement>('again');
  #busy = false;
  #timers: ReturnType<typeof setTimeout>[] = [];

  constructor(again: () => void) {
    this.#again.addEventListener('click', () => {
      this.clear();
      again();
    });
  }

  progress({ waiting, failed, message }: Progress): void {
    if (failed) this.fail(`${failed === 1 ? 'A tile is' : `${failed} tiles are`} missing: ${message}`);
    this.#work(waiting > 0);
  }

  fail(words: string): void {
    this.#say(words, true);
  }

  /** Takes back what was said. */
  clear(): void {
    this.#say('', false);
  }

  #work(busy: boolean): void {
    if (busy === this.#busy) return;
    this.#busy = busy;
    document.body.dataset.busy = String(busy);
    this.#timers.forEach(clearTimeout);
    this.#timers = [];
    if (!busy) {
      document.body.classList.remove('working');
      if (!this.#box.classList.contains('failed')) this.clear();
      return;
    }
    this.#timers.push(
      setTimeout(() => document.body.classList.add('working'), SHOWN_AFTER_MS),
      setTimeout(() => {
        if (!this.#box.classList.contains('failed')) this.#say('Still drawing. What nobody has looked at before takes a while.', false);
      }, SLOW_MS),
    );
  }

  #say(words: string, failed: boolean): void {
    this.#box.hidden = !words;
    this.#box.classList.toggle('failed', failed && Boolean(words));
    if (this.#words.textContent !== words) this.#words.textContent = words;
    this.#again.hidden = !failed;
  }
}
