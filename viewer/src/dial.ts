/** Drawings of the sun's path over a day: its altitude above the time slider, and its azimuth around the sky. */

import { svg } from './dom';
import { DAY_MINUTES } from './moments';
import { type SunAngles, type SunDay, sunAt } from './sun_day';

/** The drawing's own units; it is stretched to the slider's width. */
const WIDTH = 1000;
const HEIGHT = 100;
const STEP_MIN = 10;
/** The part of the height that lies below the horizon. */
const BELOW = 0.26;
/** Below the horizon the path levels off: how deep the sun is at night is nobody's question. */
const NIGHT_DEG = 10;

const SKY = 100;

export class HeightDial {
  readonly element = svg('svg', { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: 'none', 'aria-hidden': 'true', class: 'height-dial' });
  /** Round, whatever the drawing's width: an element of HTML over it. */
  readonly dot = Object.assign(document.createElement('span'), { className: 'sun-dot' });
  #day: SunDay | null = null;

  /** Draws another day; null: none is known yet. */
  show(day: SunDay | null): void {
    this.#day = day;
    this.element.replaceChildren();
    this.dot.hidden = day === null;
    if (!day) return;
    const curve = Array.from({ length: DAY_MINUTES / STEP_MIN + 1 }, (_, step) => this.#place(step * STEP_MIN));
    const points = curve.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join(' ');
    const horizon = heightOf(0);
    const lit = curve.map(([x, y]) => `${x.toFixed(1)},${Math.min(y, horizon).toFixed(1)}`).join(' ');
    this.element.append(
      svg('rect', { class: 'under', x: 0, y: horizon, width: WIDTH, height: HEIGHT - horizon }),
      svg('polygon', { class: 'day', points: `0,${horizon} ${lit} ${WIDTH},${horizon}` }),
      svg('polyline', { class: 'path', points }),
      svg('line', { class: 'horizon', x1: 0, x2: WIDTH, y1: horizon, y2: horizon }),
      ...[day.sunrise, day.noon, day.sunset].map((minutes) => {
        if (minutes === null) return '';
        const [x, y] = this.#place(minutes);
        return svg('line', { class: 'mark', x1: x, x2: x, y1: Math.min(y, horizon), y2: HEIGHT });
      }),
    );
  }

  /** Puts the sun where it stands at minutes of the day. */
  move(minutes: number): void {
    if (!this.#day) return;
    const [x, y] = this.#place(minutes);
    this.dot.style.left = `${(100 * x) / WIDTH}%`;
    this.dot.style.top = `${(100 * y) / HEIGHT}%`;
    this.dot.classList.toggle('down', sunAt(this.#day, minutes).altitude < 0);
  }

  #place(minutes: number): [number, number] {
    return [(WIDTH * minutes) / DAY_MINUTES, this.#day ? heightOf(sunAt(this.#day, minutes).altitude) : HEIGHT];
  }
}

/** Heights grow with the sine: the middle of the day is no peak, and low suns, which cast long shadows, have room. */
function heightOf(altitudeDeg: number): number {
  const up = HEIGHT * (1 - BELOW);
  if (altitudeDeg >= 0) return up - (up - 8) * Math.sin((altitudeDeg * Math.PI) / 180);
  return up + (HEIGHT - up - 2) * Math.tanh(-altitudeDeg / NIGHT_DEG);
}

/** The sky as a disc: the horizon its rim, north on top, the zenith its middle. */
export class SkyDial {
  readonly element = svg('svg', { viewBox: '-124 -124 248 248', class: 'sky-dial', 'aria-hidden': 'true' });
  readonly #path = svg('path', { class: 'path' });
  readonly #ray = svg('line', { class: 'ray', x1: 0, y1: 0 });
  readonly #dot = svg('circle', { class: 'sun', r: 12 });

  constructor() {
    this.element.append(
      svg('circle', { class: 'rim', r: SKY }),
      svg('circle', { class: 'ring', r: SKY * (2 / 3) }), svg('circle', { class: 'ring', r: SKY / 3 }),
      svg('path', { class: 'ticks', d: 'M100 0h10M-100 0h-10M0 100v10' }),
      svg('text', { y: -105, 'text-anchor': 'middle' }, 'N'),
      this.#path, this.#ray, this.#dot,
    );
  }

  show(day: SunDay | null): void {
    if (!day) {
      this.#path.setAttribute('d', '');
      return;
    }
    let pen = 'M';
    const drawn = Array.from({ length: DAY_MINUTES / STEP_MIN + 1 }, (_, step) => sunAt(day, step * STEP_MIN)).map((sun) => {
      if (sun.altitude < 0) {
        pen = 'M';
        return '';
      }
      const [x, y] = onDisc(sun);
      const part = `${pen}${x.toFixed(1)} ${y.toFixed(1)}`;
      pen = 'L';
      return part;
    });
    this.#path.setAttribute('d', drawn.join(''));
  }

  move(sun: SunAngles | null): void {
    this.#dot.classList.toggle('none', sun === null);
    this.#ray.classList.toggle('none', sun === null || sun.altitude < 0);
    if (!sun) return;
    const [x, y] = onDisc(sun);
    for (const [name, value] of [['cx', x], ['cy', y]] as const) this.#dot.setAttribute(name, value.toFixed(1));
    for (const [name, value] of [['x2', x], ['y2', y]] as const) this.#ray.setAttribute(name, value.toFixed(1));
    this.#dot.classList.toggle('down', sun.altitude < 0);
  }
}

function onDisc({ azimuth, altitude }: SunAngles): [number, number] {
  const radius = SKY * (1 - Math.max(0, altitude) / 90);
  const angle = (azimuth * Math.PI) / 180;
  return [radius * Math.sin(angle), -radius * Math.cos(angle)];
}
