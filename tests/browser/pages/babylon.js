import { FreeCamera } from '@babylonjs/core/Cameras/freeCamera.js'
import { Engine } from '@babylonjs/core/Engines/engine.js'
import { Color4 } from '@babylonjs/core/Maths/math.color.js'
import { Matrix, Quaternion, Vector3 } from '@babylonjs/core/Maths/math.vector.js'
import { GaussianSplattingMesh } from '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js'
import { Scene } from '@babylonjs/core/scene.js'
import { canvas, drawUntil, readPixels } from './common.js'

// From OpenGL's view to that of a scene with left-handed axes: y is mirrored in the world, z in the camera.
const MIRRORED = { world: Matrix.Scaling(1, -1, 1), camera: Matrix.Scaling(1, 1, -1) }

// `settings`: of the splats' material, such as compensation; its defaults are what users see.
export async function start(settings) {
  const engine = new Engine(canvas, false, { antialias: false })
  const scene = new Scene(engine)
  const camera = new FreeCamera('eye', Vector3.Zero(), scene)
  camera.rotationQuaternion = Quaternion.Identity()
  camera.minZ = 0.01
  let splats = null

  return {
    async open(url) {
      splats?.dispose()
      const file = await (await fetch(url)).arrayBuffer()
      const { buffer, sh, shDegree } = await GaussianSplattingMesh.ConvertPLYWithSHToSplatAsync(file)
      splats = new GaussianSplattingMesh('splats', null, scene)
      splats.updateData(buffer, sh, { flipY: false }, undefined, shDegree)
      splats.scaling.y = -1 // as its loader of files does, for left-handed axes
      splats.viewUpdateThreshold = 0 // a viewer in motion keeps its order for turns of less than this
      Object.assign(splats.material, settings)
    },

    async draw(view) {
      engine.setSize(view.width, view.height)
      scene.clearColor = new Color4(...view.background, 1)
      const viewmat = MIRRORED.world.multiply(Matrix.FromArray(view.viewmat)).multiply(MIRRORED.camera)
      viewmat.invert().decompose(undefined, camera.rotationQuaternion, camera.position)
      camera.freezeProjectionMatrix(MIRRORED.camera.multiply(Matrix.FromArray(view.projection)))
      await scene.whenReadyAsync() // until its shaders are compiled it draws nothing
      await drawUntil(
        () => isSorted(splats, camera),
        () => scene.render(),
      )
      return readPixels(engine._gl, view)
    },
  }
}

// Whether the order that is drawn is that of this camera, and none is on its way.
function isSorted(splats, camera) {
  const info = splats._cameraViewInfos.get(camera.uniqueId)
  const isOfCamera = info && info.sortAppliedId > 0 && info.sortAppliedId === info.sortRequestId
  return isOfCamera && splats._canPostToWorker && !splats._isSortStateDirty(info, splats.computeWorldMatrix(), camera)
}
