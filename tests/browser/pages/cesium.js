import { canvas, drawUntil, nextFrame, readPixels } from './common.js'

const BUILT = '/node_modules/cesium/Build/Cesium/'

// 3D Tiles in Cesium, without its globe and sky. It has no settings: those of a tileset are what its users see.
export async function start() {
  window.CESIUM_BASE_URL = BUILT
  const { Cartesian3, Cesium3DTileset, Color, PerspectiveFrustum, Scene } = await import(`${BUILT}index.js`)
  const scene = new Scene({ canvas, msaaSamples: 1, contextOptions: { webgl: { antialias: false } } })
  for (const part of ['globe', 'skyBox', 'skyAtmosphere', 'sun', 'moon']) scene[part] = undefined
  let tileset = null

  // What lies at (x, y, z) of a PLY lies at (-x, -z, -y) of a tile.
  const inTile = ([x, y, z]) => new Cartesian3(-x, -z, -y)

  function pose({ projection, viewmat, width, height, background }) {
    canvas.width = width
    canvas.height = height
    scene.backgroundColor = new Color(...background, 1)
    const [right, up, back] = [0, 1, 2].map((row) => [viewmat[row], viewmat[row + 4], viewmat[row + 8]])
    const eye = [0, 1, 2].map((axis) => -(right[axis] * viewmat[12] + up[axis] * viewmat[13] + back[axis] * viewmat[14]))
    const [wide, high] = [1 / projection[0], 1 / projection[5]] // tangents of half a field of view
    const near = 0.01
    Object.assign(scene.camera, { position: inTile(eye), right: inTile(right), up: inTile(up), direction: inTile(back.map((each) => -each)) })
    scene.camera.frustum = new PerspectiveFrustum({
      fov: 2 * Math.atan(Math.max(wide, high)),
      aspectRatio: wide / high,
      near,
      xOffset: near * wide * projection[8],
      yOffset: near * high * projection[9],
    })
  }

  function frame() {
    scene.initializeFrame()
    scene.render()
  }

  const files = () => tileset._selectedTiles.map((tile) => tile.content.url.split('/').pop())

  return {
    async open(url) {
      if (tileset) scene.primitives.remove(tileset)
      tileset = await Cesium3DTileset.fromUrl(url)
      scene.primitives.add(tileset)
    },

    async draw(view) {
      pose(view)
      const splats = () => tileset.gaussianSplatPrimitive
      const before = splats()?._splatDataGeneration ?? 0
      if (splats()) splats()._dirty = true // it sorts anew after a move of 1 unit or a turn of half a degree only
      await drawUntil(() => tileset.tilesLoaded && splats() && isSorted(splats(), before), frame)
      return readPixels(scene.context._gl, view)
    },

    // The names of the files that are shown from each of many cameras.
    async chosen(views) {
      const found = []
      for (const view of views) {
        pose(view)
        do {
          frame()
          await nextFrame()
          frame()
        } while (!tileset.tilesLoaded)
        found.push(files())
      }
      return found
    },
  }
}

// Whether what is drawn was gathered and sorted after another time, of the tiles that are wanted, and nothing is on its way.
function isSorted(splats, before) {
  const isWhole = !splats._needsSnapshotRebuild && !splats._pendingSnapshot && !splats._pendingSortPromise
  return isWhole && splats._sorterState === 0 && splats._splatDataGeneration > before
}
