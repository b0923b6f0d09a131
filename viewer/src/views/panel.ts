/** The panel of views: the level's views as thumbnails, and the button that makes one. */

import { html } from '../dom';
import type { Panel, PanelContext } from '../panels';
import { type Level, isPlaced } from '../service';
import type { State } from '../state';
import { mountMaker } from './maker';
import { parsePosition } from './camera';
import { Picture, snapshotQuery } from './snapshot';
import { viewTitle } from './titles';
import { openPicture } from './whole_picture';
import './views.css';

const THUMBNAIL_PX = 240;
const CALM_MS = 500;

/** Width and height of a small picture of a view, as wide as the usual one, in the view's own proportions. */
export function thumbnailSize(size: readonly [number, number] | null): string {
  const [width, height] = size ?? [5, 4];
  return width >= height
    ? `${THUMBNAIL_PX}x${Math.max(Math.round((THUMBNAIL_PX * height) / width), 1)}`
    : `${Math.max(Math.round((THUMBNAIL_PX * width) / height), 1)}x${THUMBNAIL_PX}`;
}

function mount(container: HTMLElement, context: PanelContext): () => void {
  const { store } = context;
  const gallery = html('section', { 'aria-label': 'Views of the level' });
  const maker = html('section', { 'aria-label': 'A view of your own' });
  container.append(gallery, maker);
  let closeGallery = () => {};
  const endLevel = store.watch(({ level }) => level, () => {
    closeGallery();
    closeGallery = mountGallery(gallery, context, context.level());
    // Eyes and targets are longitudes and latitudes.
    maker.hidden = !isPlaced(context.level());
  });
  const closeMaker = mountMaker(maker, context);
  return () => {
    endLevel();
    closeGallery();
    closeMaker();
  };
}

function mountGallery(container: HTMLElement, { store, service }: PanelContext, level: Level): () => void {
  const pictures = new Map<string, Picture>();
  const list = html('ul', { class: 'gallery' });
  for (const name of level.views) {
    const kind = level.view_kinds[name];
    if (!kind?.size) continue; // it cannot be drawn, as the service's log says
    const picture = new Picture(service, '');
    pictures.set(name, picture);
    const address = (state: State, suffix: 'png' | 'webp', px: string | null) =>
      service.of(level.name, `snapshot.${suffix}`, { view: name, size: px, ...snapshotQuery(state) });
    const { size } = kind;
    const open = () => openPicture(
      service, `${viewTitle(name)} · ${level.title}`, address(store.state, 'png', null), `${level.name}-${name}`,
      isPlaced(level) ? { level, state: store.state, size, film: { view: name }, address } : null,
    );
    list.append(html('li', {}, html('button', { type: 'button', onclick: open }, picture.element, html('span', { class: 'name' }, viewTitle(name)))));
  }
  container.replaceChildren(html('h2', {}, 'Views of the level'), pictures.size
    ? list
    : html('p', { class: 'note' }, 'The level lists none that can be drawn.'));
  let timer: number | undefined;
  const draw = async (query: ReturnType<typeof snapshotQuery>) => {
    // One after another: the map's tiles are asked for meanwhile, too.
    for (const [name, picture] of pictures) {
      await picture.show(service.of(level.name, 'snapshot.webp', { view: name, size: thumbnailSize(level.view_kinds[name]?.size ?? null), ...query }));
    }
  };
  const end = store.watch(snapshotQuery, (query) => {
    clearTimeout(timer);
    timer = window.setTimeout(() => void draw(query), CALM_MS);
  });
  return () => {
    end();
    clearTimeout(timer);
    for (const picture of pictures.values()) picture.close();
  };
}

/** What of the address's parts is no place. */
function faults(own: Readonly<Record<string, string>>): string[] {
  return ['views-eye', 'views-target'].filter((name) => own[name] !== undefined && !parsePosition(own[name]))
    .map((name) => `${name}=${own[name]} is not understood: longitude,latitude,metres above the ground`);
}

export const viewsPanel: Panel = { id: 'views', title: 'Views', needsNoMap: true, faults, mount };
