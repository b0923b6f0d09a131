/** Layout of the page, as its style sheet defines it: the panel beside the map, as a sheet over its lower part, or as a drawer. */

import { byId } from './dom';

/** A phone held upright: the panel is a sheet that comes up from below. */
const SHEET = '(max-width: 700px) and (min-height: 501px)';
/** A phone held across: the panel is a drawer at the left, the dock is low. */
const LOW = '(max-height: 500px)';

export const isSheet = () => matchMedia(SHEET).matches;
/** Whether the panel lies over the map only while somebody wants it. */
export const isFolding = () => isSheet() || matchMedia(LOW).matches;

/** Edges of a part of the window, CSS pixels. */
export interface Area {
  readonly left: number;
  readonly top: number;
  readonly right: number;
  readonly bottom: number;
}

/** What of the window is the map's own while the panel is open. */
export function freeArea(): Area {
  const [side, dock] = [byId('side'), byId('sun').getBoundingClientRect()];
  const [right, height] = [window.innerWidth, window.innerHeight];
  // It may still be on its way up, and grow with what is found.
  if (isSheet()) return { left: 0, top: 0, right, bottom: height - Math.min(0.78 * height, 640) };
  return { left: side.getBoundingClientRect().right, top: 0, right, bottom: dock.top };
}

/** CSS pixels at the left that the panel always covers. */
export function coveredLeft(): number {
  return parseFloat(getComputedStyle(document.documentElement).getPropertyValue('--covered')) || 0;
}
