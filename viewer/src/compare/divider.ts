/** The line between two maps, which is dragged, or moved by the keys of a slider. */

import { html } from '../dom';
import { coveredLeft } from '../layout';

const STEP = 0.02;
const PAGE = 0.1;

/** Where a key moves the divider, 0 to 1; null: it does not. */
export function afterKey(key: string, split: number): number | null {
  const moved: Record<string, number> = {
    ArrowLeft: split - STEP, ArrowDown: split - STEP, ArrowRight: split + STEP, ArrowUp: split + STEP,
    PageDown: split - PAGE, PageUp: split + PAGE, Home: 0, End: 1,
  };
  const to = moved[key];
  return to === undefined ? null : Math.min(Math.max(Number(to.toFixed(4)), 0), 1);
}

export class Divider {
  readonly element: HTMLElement;
  readonly #handle: HTMLElement;
  readonly #left = html('span', { class: 'side left' });
  readonly #right = html('span', { class: 'side right' });
  #split = 0.5;

  constructor(private readonly place: HTMLElement, moved: (split: number) => void, closed: () => void) {
    this.#handle = html('div', { class: 'handle', role: 'slider', tabindex: 0, 'aria-label': 'Divider of the comparison', 'aria-valuemin': 0, 'aria-valuemax': 100 });
    const close = html('button', { type: 'button', class: 'end', 'aria-label': 'End the comparison', onclick: closed }, '×');
    this.element = html('div', { class: 'divider' }, this.#left, this.#right, this.#handle, close);
    this.#handle.addEventListener('keydown', (event) => {
      const to = afterKey(event.key, this.#split);
      if (to === null) return;
      event.preventDefault();
      event.stopPropagation();
      moved(to);
    });
    this.#handle.addEventListener('pointerdown', (event) => {
      event.preventDefault();
      event.stopPropagation();
      this.#handle.focus();
      this.#handle.setPointerCapture(event.pointerId);
    });
    this.#handle.addEventListener('pointermove', (event) => {
      if (!this.#handle.hasPointerCapture(event.pointerId)) return;
      const { left, width } = this.place.getBoundingClientRect();
      const covered = coveredLeft();
      moved(Math.min(Math.max((event.clientX - left - covered) / (width - covered), 0), 1));
    });
    place.append(this.element);
  }

  show(split: number, left: string, right: string): void {
    this.#split = split;
    const percent = Math.round(100 * split);
    this.element.style.setProperty('--split', String(split));
    this.#left.textContent = left;
    this.#right.textContent = right;
    this.#handle.setAttribute('aria-valuenow', String(percent));
    this.#handle.setAttribute('aria-valuetext', `${percent} %: ${left} on the left, ${right} on the right`);
  }

  remove(): void {
    this.element.remove();
  }
}
